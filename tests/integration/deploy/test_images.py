"""The container images, as far as they can be judged without building them: sources, pins, user, what pip is told."""

import re
import shlex
import tomllib
from fnmatch import fnmatch

import pytest

from tests.helpers.paths import ROOT

IMAGES = ["Dockerfile", "Dockerfile.gpu"]


def instructions(name: str) -> list[tuple[str, str]]:
    text = re.sub(r"\\\n", " ", re.sub(r"^\s*#.*\n", "", (ROOT / "docker" / name).read_text(), flags=re.MULTILINE))
    return [tuple(line.split(None, 1)) for line in text.splitlines() if line.strip()]


@pytest.mark.parametrize("name", IMAGES)
def test_what_is_copied_is_there_and_docker_is_shown_it(name):
    rules = [line for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")]
    for instruction, rest in instructions(name):
        if instruction != "COPY" or rest.startswith("--from="):
            continue
        for source in rest.split()[:-1]:
            assert (ROOT / source).exists(), source
            assert any(fnmatch(source, rule[1:].removesuffix("/**")) for rule in rules), source


@pytest.mark.parametrize("name", IMAGES)
def test_nobody_runs_as_root(name):
    users = [rest for instruction, rest in instructions(name) if instruction == "USER"]
    assert users[-1] == "10001"


@pytest.mark.parametrize("name", IMAGES)
def test_everything_that_pip_installs_is_pinned(name):
    pips = [rest for instruction, rest in instructions(name) if instruction == "RUN" and "pip install" in rest]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for line in pips:
        (command,) = [part for part in line.split("&&") if "pip install" in part]
        words = shlex.split(command)
        assert words[words.index("-c") + 1].endswith("constraints.txt")
        assert "--no-cache-dir" in words
        assert set(re.findall(r"\[([a-z0-9,]+)\]", words[-1])[0].split(",")) <= set(extras)
    assert pips


def test_the_base_is_one_release_and_both_images_share_it():
    cpu, gpu = (dict(instructions(name)[:1]) for name in IMAGES)
    assert re.fullmatch(r"PYTHON=3\.11\.\d+-slim-bookworm", cpu["ARG"])
    assert gpu["ARG"] == "BASE=tableverse-factory:cpu"
    froms = [rest for name in IMAGES for instruction, rest in instructions(name) if instruction == "FROM"]
    assert froms == ["python:${PYTHON} AS builder", "python:${PYTHON}", "${BASE}"]


def test_make_builds_both():
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(r"^image: .*\n\tdocker build -f docker/Dockerfile -t tableverse-factory:cpu \.$", makefile, re.M)
    assert re.search(r"^image-gpu: image .*\n\tdocker build -f docker/Dockerfile\.gpu .*:gpu \.$", makefile, re.M)


def test_every_dependency_has_its_pin():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in (ROOT / "constraints.txt").read_text().split()}
    wanted = [
        *project["dependencies"],
        *(r for name in ("cluster", "models", "bench") for r in project["optional-dependencies"][name]),
    ]
    names = {re.match(r"[A-Za-z0-9._-]+", requirement)[0].lower().replace("_", "-") for requirement in wanted}
    assert names <= pinned
