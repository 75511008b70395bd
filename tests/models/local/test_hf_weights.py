"""Weights of the hub: which commit is meant, that it is what is loaded, and that a build stays at it."""

import pytest

from schemas.config import Config
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.local.device import Device
from tableverse_factory.models.local.hf_weights import pin_commit, resolve_hub_name
from tableverse_factory.models.local.recorded_weights import pin_commits
from tableverse_factory.run_record import collect_external_inputs, make_run_record
from tableverse_factory.stages.perceive.sam.model import load_sam
from tests.helpers.sam_models import save_tiny
from tests.helpers.weights_hub import Model, weights_hub

pytestmark = pytest.mark.heavy

CPU = Device("cpu", "float32")
KEY = "perceive.segmenter_weights"
NAME = "someone/tiny-sam"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    made = [tmp_path_factory.mktemp("weights") for _ in range(2)]
    for seed, folder in enumerate(made):
        save_tiny("sam2", folder, seed)
    return made


@pytest.fixture
def hub(monkeypatch, tmp_path, folders):
    """A hub whose `main` has gone on since `v1`."""
    with weights_hub(monkeypatch, tmp_path / "cache") as running:
        model = running.models[NAME] = Model()
        model.refs["v1"] = model.commit(folders[0])
        model.commit(folders[1])
        yield running


def config(weights):
    return Config.model_validate(
        {"perceive": {"detector": "replay", "segmenter": "sam2", "segmenter_weights": weights}}
    )


def first_weight(model):
    return next(model._model.mask_decoder.parameters()).flatten()[:8].tolist()


def run_of(weights, before=None):
    settings = config(weights)
    return make_run_record(settings, collect_external_inputs(settings, before), "0" * 64, 1, {})


def test_what_is_loaded_is_the_revision_that_is_named(hub, folders):
    old, new = (first_weight(load_sam("sam2", str(folder), CPU)) for folder in folders)
    assert old != new
    refs = hub.models[NAME].refs
    assert first_weight(load_sam("sam2", NAME, CPU)) == new
    assert first_weight(load_sam("sam2", f"{NAME}@v1", CPU)) == old
    assert first_weight(load_sam("sam2", f"{NAME}@{refs['v1']}", CPU)) == old


def test_a_build_stays_at_the_commit_that_it_began_with(hub, folders):
    main = hub.models[NAME].refs["main"]
    first = run_of(NAME)
    assert first["segmenter"]["weights"] == f"{NAME}@{main}"
    assert first["config"]["perceive"]["segmenter_weights"] == NAME
    stages = pin_commits(config(NAME), first)
    assert stages.perceive.segmenter_weights == f"{NAME}@{main}"
    assert stages.perceive.segmenter == "sam2"
    hub.models[NAME].commit(folders[0])
    hub.asked.clear()
    assert run_of(NAME, before=first) == first
    assert not hub.asked
    assert first_weight(load_sam("sam2", stages.perceive.segmenter_weights, CPU)) == first_weight(
        load_sam("sam2", str(folders[1]), CPU)
    )


def test_another_commit_is_another_run(hub, monkeypatch, tmp_path):
    first, tagged = run_of(NAME), run_of(f"{NAME}@v1")
    assert first["segmenter"]["weights"] != tagged["segmenter"]["weights"]
    assert first["fingerprint"] != tagged["fingerprint"]
    assert run_of(f"{NAME}@v1", before=first) == tagged  # what is written differently is looked up


def test_what_is_in_the_cache_asks_nobody(hub, folders):
    begun = run_of(NAME)
    load_sam("sam2", begun["segmenter"]["weights"], CPU)
    hub.models[NAME].commit(folders[0])
    hub.asked.clear()
    assert run_of(NAME) == begun
    load_sam("sam2", begun["segmenter"]["weights"], CPU)
    assert not hub.asked


def test_a_whole_commit_needs_no_hub(hub):
    named = f"{NAME}@{'a' * 40}"
    assert run_of(named)["segmenter"]["weights"] == named
    assert not hub.asked


def refused(weights):
    with pytest.raises(ModelAccessError, match=r"perceive\.segmenter_weights = ") as told:
        pin_commit(weights, KEY)
    assert "\n" not in str(told.value)
    return str(told.value)


def test_what_the_hub_does_not_know_is_said_before_the_build_begins(hub, monkeypatch):
    assert "knows no 'v9' of this model" in refused(f"{NAME}@v9")
    assert "knows no such model" in refused("someone/else")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert f"`hf download {NAME} --revision v1`" in refused(f"{NAME}@v1")


def test_a_hub_that_says_nothing_is_not_waited_for_without_end(hub, monkeypatch):
    monkeypatch.setattr("tableverse_factory.models.local.hf_weights.HUB_TIMEOUT_S", 0.2)
    hub.silent_s = 1.0
    assert "is not on this machine and the hub cannot be reached:" in refused(NAME)


def test_a_client_that_is_too_old_to_ask_is_named(hub, monkeypatch):
    monkeypatch.delattr("huggingface_hub.HfApi.resolve_revision")
    assert "pip install 'huggingface_hub>=1.26'" in refused(NAME)


def test_a_missing_revision_and_a_gated_model_are_told_apart_where_they_are_loaded(hub):
    with pytest.raises(ModelAccessError, match="knows no 'v9' of this model"):
        load_sam("sam2", f"{NAME}@v9", CPU)
    hub.gated.add(NAME)
    with pytest.raises(ModelAccessError, match="is gated"):
        load_sam("sam2", NAME, CPU)


@pytest.mark.parametrize("weights", ["./weights/sam2", "/weights/sam2", "~/sam2", "sam2", "a/b/c", "a/b@", "a b/c"])
def test_a_path_is_no_name_on_the_hub(weights):
    assert resolve_hub_name(weights, KEY) is None


def test_a_home_is_where_the_shell_has_it(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    assert config("~/sam2").perceive.segmenter_weights == "/home/somebody/sam2"
    assert config(NAME).perceive.segmenter_weights == NAME


def test_a_folder_like_a_name_on_the_hub_is_never_guessed(hub, folders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "someone").mkdir()
    (tmp_path / NAME).symlink_to(folders[0])
    for weights in (NAME, f"{NAME}@v1"):
        with pytest.raises(ModelAccessError, match=rf"'{weights}' may be a name on the hub .* write './{NAME}'"):
            run_of(weights)
    assert "sha256" in run_of(f"./{NAME}")["segmenter"]
    assert first_weight(load_sam("sam2", f"./{NAME}", CPU)) == first_weight(load_sam("sam2", str(folders[0]), CPU))
