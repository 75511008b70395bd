# Single verbs; CI calls the same ones. `make` alone lists them.
SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO ?= demo
SCENES ?= 6
TASKS ?= 3
export OMP_NUM_THREADS ?= 1
# Hundreds of processes import us in the tests: none of them compiles what another has compiled.
unexport PYTHONDONTWRITEBYTECODE

# A full disk ends an installation in the middle, with hundreds of lines; this is one line before.
room = @free=$$(df -Pk . | awk 'NR == 2 { print int($$4 / 1048576) }'); test $$free -ge $(1) || \
	{ echo "error: installing needs $(1) GB of free disk, and $$free GB are free in $(CURDIR)" >&2; exit 1; }

.PHONY: help setup develop browser demo check format test test-fast test-all docs build image image-gpu clean

help: ## list the verbs
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

setup: $(VENV)/.ready ## install what running needs into .venv

develop: $(VENV)/.develop ## and what testing and documentation need

$(VENV)/.ready: pyproject.toml constraints.txt deploy/system-libraries.sh
	$(if $(wildcard $(BIN)/tableverse),,$(call room,3))
	@deploy/system-libraries.sh
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: $(PYTHON) is older than 3.11; name a newer one: make setup PYTHON=python3.12" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV): about 2 GB, some minutes"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[viewer]'
	@touch $@

$(VENV)/.develop: $(VENV)/.ready
	$(if $(wildcard $(BIN)/pytest),,$(call room,3))
	@echo "installing what tests and documentation need: about 2 GB more"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,docs]'
	@touch $@

browser:
	@deploy/system-libraries.sh browser || echo "without a Chromium its tests are skipped" >&2

demo: setup ## captures and bare pictures -> dataset (Ray) with trajectories -> verify -> gallery
	rm -rf $(DEMO)
	$(BIN)/tableverse synth $(DEMO)/captures --scenes $(SCENES) --seed 7
	$(BIN)/tableverse synth $(DEMO)/other --scenes 1 --seed 8
	mkdir $(DEMO)/pictures && mv $(DEMO)/other/*/color.png $(DEMO)/pictures/table.png
	$(BIN)/python -c 'import skimage.data as data; from PIL import Image; \
		Image.fromarray(data.coffee()).save("$(DEMO)/pictures/coffee.png")'
	$(BIN)/tableverse manifest $(DEMO)/captures $(DEMO)/pictures --out $(DEMO)/images.parquet
	$(BIN)/tableverse build $(DEMO)/images.parquet $(DEMO)/out --executor ray \
		--stages +trajectories --set trajectories.max_tasks=$(TASKS)
	$(BIN)/tableverse status $(DEMO)/out
	$(BIN)/tableverse verify $(DEMO)/out --trajectories
	$(BIN)/tableverse report $(DEMO)/out --dest $(DEMO)/gallery

check: develop ## format, lint, types, layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: develop ## rewrite the code as `check` wants it
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test: develop browser ## the tests but the slow ones, a quarter of an hour on 2 cores
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder -m 'not slow'

test-fast: develop ## what to run while typing: no processes, at most 90 s
	$(BIN)/pytest --fast -n 2 -q

test-all: develop browser ## the slow ones too
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

docs: develop ## the documentation site, warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

build: setup ## a wheel in dist/
	$(BIN)/python -m pip wheel --quiet --no-deps -w dist .

image: ## the CPU container image
	docker build -f docker/Dockerfile -t tableverse-factory:cpu .

image-gpu: image ## the GPU one, on top of it
	docker build -f docker/Dockerfile.gpu --build-arg BASE=tableverse-factory:cpu -t tableverse-factory:gpu .

clean: ## remove what the verbs made, but not .venv
	rm -rf $(DEMO) dist site .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
