"""`tableverse models` as a user meets it, and the recipes, which are configurations of models of its table."""

import json
import sys

import pytest

from tableverse_factory.core.config import load_config
from tableverse_factory.models.local.catalogue import CATALOGUE, get_model
from tableverse_factory.models.local.weight_files import find_models, locate_repository
from tests.helpers.paths import ROOT
from tests.helpers.sam_models import save_tiny
from tests.helpers.weights_hub import Model, weights_hub

RECIPES = sorted((ROOT / "recipes").glob("*.yaml"))
CPU, GPU = (ROOT / "recipes" / f"pictures-{device}.yaml" for device in ("cpu", "gpu"))
SAM = get_model("sam2.1-tiny")


@pytest.fixture
def hub(monkeypatch, tmp_path):
    with weights_hub(monkeypatch, tmp_path / "cache") as running:
        yield running


@pytest.fixture
def config(hub, tmp_path):
    """A configuration with other weights of a model in the table, which the hub has."""
    save_tiny("sam2", tmp_path / "sam")
    commit = (hub.models.setdefault(SAM.repository, Model())).commit(tmp_path / "sam")
    written = tmp_path / "config.yaml"
    written.write_text(
        f"perceive:\n  detector: replay\n  segmenter: sam2\n  segmenter_weights: {SAM.repository}@{commit}\n"
    )
    return written


def test_the_list_names_every_model_with_its_licence_and_what_it_forbids(tableverse):
    shown = tableverse("models", "list")
    assert shown.code == 0
    for model in CATALOGUE:
        assert f"{model.name}: {model.purpose}" in shown.out
        assert model.weights in shown.out
        assert model.forbids in shown.out
        assert all(file.sha256 in shown.out for file in model.files)
    rows = json.loads(tableverse("models", "list", "--json").out)
    assert [row["name"] for row in rows] == [model.name for model in CATALOGUE]
    nested = next(row for row in rows if row["name"] == "da3-nested")
    assert (nested["licence"], nested["forbids"]) == ("CC-BY-NC-4.0", "commercial use")


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_a_recipe_is_a_configuration_of_pinned_models(tableverse, recipe):
    assert tableverse("config", "--config", recipe).code == 0
    used, others = find_models(load_config(recipe))
    assert not others
    assert all(model in CATALOGUE for model in used), "at the commits of the table"
    listed = tableverse("models", "list", "--config", recipe)
    assert [line.partition(":")[0] for line in listed.out.splitlines() if not line.startswith(" ")] == [
        model.name for model in used
    ]


def test_the_recipes_are_what_they_say():
    used = {path: [model.name for model in find_models(load_config(path))[0]] for path in RECIPES}
    assert used[CPU] == ["depth-anything-v2-small", "grounding-dino-tiny", "sam2.1-tiny"]
    assert used[GPU] == ["da3-nested", "sam2.1-large", "sam-3d-objects"]
    assert {model.licence for model in find_models(load_config(CPU))[0]} == {"Apache-2.0"}
    assert load_config(GPU).perceive.protocol == "openai"
    assert load_config(GPU).curate.protocol == "gemini"


@pytest.mark.heavy
def test_fetch_and_check_what_a_configuration_uses(tableverse, hub, config):
    missing = tableverse("models", "check", "--config", config)
    assert (missing.code, missing.out) == (1, "sam2.1-tiny: missing\n")
    assert "tableverse models fetch sam2.1-tiny" in missing.err
    first = tableverse("models", "fetch", "--config", config)
    assert first.code == 0
    assert first.out.startswith("sam2.1-tiny: 0.5 MB fetched and checked")
    again = tableverse("models", "fetch", "--config", config, "--json")
    assert [file["how"] for file in json.loads(again.out)[0]["files"]] == ["present", "present"]
    there = tableverse("models", "check", "--config", config)
    assert there.code == 0
    assert there.out.startswith(f"sam2.1-tiny: present in {locate_repository(SAM)}")


@pytest.mark.heavy
def test_check_finds_damage_whether_or_not_it_was_asked_for(tableverse, hub, config):
    tableverse("models", "fetch", "--config", config)
    (weights,) = locate_repository(SAM).glob("snapshots/*/model.safetensors")
    weights.resolve().write_bytes(b"")
    found = tableverse("models", "check", "--config", config)
    assert found.code == 1
    assert "    model.safetensors: damaged, 0 bytes, not " in found.out
    rows = json.loads(tableverse("models", "check", "--json", "--config", config).out)
    assert [(row["name"], row["state"]) for row in rows] == [("sam2.1-tiny", "damaged")]
    assert {file["name"]: file["state"] for file in rows[0]["files"]} == {
        "config.json": "present",
        "model.safetensors": "damaged",
    }


def test_a_machine_without_weights_is_no_failure_until_one_is_named(tableverse, hub):
    everything = tableverse("models", "check")
    assert everything.code == 0
    assert "grounding-dino-tiny: missing" in everything.out
    assert "triposr: elsewhere" in everything.out
    assert not hub.asked
    assert tableverse("models", "check", "grounding-dino-tiny").code == 1


@pytest.mark.heavy
def test_weights_that_are_not_those_of_the_table_are_not_fetched(tableverse, hub, config):
    listed = hub.models[SAM.repository]
    listed.commits[SAM.revision] = listed.commits[listed.refs["main"]]
    refused = tableverse("models", "fetch", "sam2.1-tiny")
    assert refused.code == 1
    assert "and 155908064 are known: not fetched" in refused.err


def test_a_plain_installation_is_told_what_to_install(tableverse, monkeypatch):
    for module in ("huggingface_hub", "huggingface_hub.constants"):
        monkeypatch.setitem(sys.modules, module, None)
    for command in ("fetch", "check"):
        told = tableverse("models", command, "sam2.1-tiny")
        assert told.code == 1
        assert "error: looking for weights needs huggingface_hub: pip install 'tableverse-factory[models]'" in told.err
    listed = tableverse("models", "list")
    assert listed.err.count("pip install 'tableverse-factory[models]'") == 1


def test_mistakes_are_answered_with_what_to_type(tableverse, hub, tmp_path):
    unknown = tableverse("models", "fetch", "sam9\x1b")
    assert unknown.code == 1
    assert r"no model 'sam9\\x1b': there are grounding-dino-tiny, " in unknown.err
    assert "name models of `tableverse models list`" in tableverse("models", "fetch").err
    elsewhere = tableverse("models", "fetch", "triposr")
    assert elsewhere.code == 1
    assert "docs/mesh-process.md" in elsewhere.err
    own = tmp_path / "own.yaml"
    own.write_text("observe: {depth: depth_anything_2, depth_weights: ./mine}\n")
    skipped = tableverse("models", "fetch", "--config", own)
    assert skipped.code == 0
    assert "'./mine' is not in the table" in skipped.err
    assert not hub.asked
