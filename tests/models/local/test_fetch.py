"""Weights are fetched from a hub of this machine that speaks its protocol: resumed, bounded, checked, then in place."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from tableverse_factory.core.errors import InputError, ModelAccessError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.models.local import fetch as fetching
from tableverse_factory.models.local.catalogue import BY_REPOSITORY, CATALOGUE, DEFAULT_WEIGHTS, ModelEntry, WeightFile
from tableverse_factory.models.local.device import Device
from tableverse_factory.models.local.fetch import fetch_model
from tableverse_factory.models.local.hf_weights import GIT_HASH, pin_commit
from tableverse_factory.models.local.weight_files import (
    LOCK_NAME,
    SHA256,
    check_model,
    locate_repository,
    read_lock,
)
from tableverse_factory.stages.perceive.grounding_dino.model import load_grounding_dino
from tableverse_factory.stages.perceive.sam.model import load_sam
from tests.helpers.grounding_dino_models import save_tiny_dino
from tests.helpers.loopback import serving
from tests.helpers.sam_models import save_tiny
from tests.helpers.weights_hub import Handler, Model, weights_hub

pytestmark = pytest.mark.heavy

NAME = "someone/tiny"
WEIGHTS = "model.safetensors"
CONFIG = "config.json"
PIECE = "huggingface_hub.constants.DOWNLOAD_CHUNK_SIZE"  # 10 MB are written at a time: more than a tiny model has


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("weights")
    save_tiny("sam2", made)
    return made


@pytest.fixture
def hub(monkeypatch, tmp_path, folder):
    with weights_hub(monkeypatch, tmp_path / "cache") as running:
        running.models[NAME] = Model()
        running.models[NAME].commit(folder)
        yield running


@pytest.fixture
def model(hub) -> ModelEntry:
    files = (WeightFile(CONFIG), WeightFile(WEIGHTS))
    return ModelEntry("tiny", "segmenter", "sam2", "", NAME, hub.models[NAME].refs["main"], "MIT", "", files)


def known(model, folder, **changed) -> ModelEntry:
    """The model with size and hash of its weights in the table."""
    there = folder / WEIGHTS
    file = WeightFile(WEIGHTS, there.stat().st_size, hash_file(there))
    return replace(model, files=(WeightFile(CONFIG), replace(file, **changed)))


def fetched(model):
    return [file.how for file in fetch_model(model, lambda _: None)[1]]


def refused(model, said):
    with pytest.raises(ModelAccessError) as told:
        fetch_model(model, lambda _: None)
    assert said in str(told.value)
    assert "\n" not in str(told.value)
    return str(told.value)


def left_over(model):
    return sorted(path.name for path in (locate_repository(model) / "blobs").glob("*.partial"))


def blob(model, name):
    return (locate_repository(model) / "snapshots" / model.revision / name).resolve()


def test_what_is_fetched_is_what_every_loader_finds_without_a_network(hub, model, folder, monkeypatch):
    lines = []
    commit, files = fetch_model(known(model, folder), lines.append)
    assert commit == model.revision
    assert [(file.name, file.how, file.sha256) for file in files] == [
        (name, "fetched", hash_file(folder / name)) for name in (CONFIG, WEIGHTS)
    ]
    assert len(lines) == 2
    assert not left_over(model)
    hub.asked.clear()
    assert fetched(known(model, folder)) == ["present", "present"]
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    load_sam("sam2", model.weights, Device("cpu", "float32"))
    assert pin_commit(model.weights, "key") == model.weights
    assert not hub.asked


def test_a_detector_is_fetched_with_its_tokenizer(hub, tmp_path):
    made = tmp_path / "dino"
    save_tiny_dino(made)
    listed = next(model for model in CATALOGUE if model.name == "grounding-dino-tiny")
    hub.models[listed.repository] = Model()
    commit = hub.models[listed.repository].commit(made)
    files = tuple(WeightFile(file.name) for file in listed.files)
    own = replace(listed, revision=commit, files=files)
    assert fetched(own) == ["fetched"] * 4
    hub.models.clear()
    load_grounding_dino(own.weights, Device("cpu", "float32"))


def test_a_branch_is_fetched_at_the_commit_that_it_is_at(hub, model, folder):
    branch = replace(model, revision="")
    assert fetched(branch) == ["fetched", "fetched"]
    hub.models[NAME].commit(folder)  # the branch goes on
    assert fetched(branch) == ["present", "present"]
    assert check_model(branch).state == "present"
    assert pin_commit(NAME, "key") == model.weights


def test_a_body_that_breaks_off_is_continued_and_not_begun_again(hub, model, folder, monkeypatch):
    monkeypatch.setattr(PIECE, 1000)
    hub.cuts = 1
    assert fetched(known(model, folder)) == ["fetched", "fetched"]
    size = (folder / WEIGHTS).stat().st_size
    sent = [(path, asked) for path, asked, _ in hub.sent if path == WEIGHTS]
    assert sent == [(WEIGHTS, ""), (WEIGHTS, f"bytes={size // 2 // 1000 * 1000}-")]


def test_what_arrived_before_a_hub_gave_up_is_said_to_be_kept(hub, model, folder, monkeypatch):
    monkeypatch.setattr("time.sleep", lambda _: None)  # between the client's own attempts
    hub.cuts = 50
    assert refused(known(model, folder), f"{WEIGHTS} cannot be fetched").endswith("run the same command again")
    (name,) = left_over(model)
    partial = locate_repository(model) / "blobs" / name
    partial.write_bytes((folder / WEIGHTS).read_bytes()[:2000])
    refused(known(model, folder), "run the same command again, which goes on with what arrived")
    assert partial.stat().st_size == 2000


def test_a_killed_fetch_is_continued_where_it_was(hub, model, folder, tmp_path):
    hub.pause_s = 0.02
    script = f"""if True:
        import huggingface_hub.constants
        from tableverse_factory.models.local.catalogue import *
        from tableverse_factory.models.local.fetch import fetch_model
        {PIECE} = 20_000
        files = (WeightFile({CONFIG!r}), WeightFile({WEIGHTS!r}))
        fetch_model(ModelEntry("tiny", "segmenter", "sam2", "", {NAME!r}, {model.revision!r}, "", "", files), print)
    """
    size = (folder / WEIGHTS).stat().st_size
    partial = locate_repository(model) / "blobs" / f"{hash_file(folder / WEIGHTS)}.partial"
    process = subprocess.Popen([sys.executable, "-c", script], env=os.environ)
    until = time.monotonic() + 60
    while not (partial.exists() and partial.stat().st_size) and time.monotonic() < until and process.poll() is None:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    arrived = partial.stat().st_size
    assert 0 < arrived < size
    assert check_model(model).state == "missing"
    hub.pause_s = 0.0
    hub.sent.clear()
    assert fetched(known(model, folder)) == ["present", "fetched"]
    assert [asked for path, asked, _ in hub.sent if path == WEIGHTS] == [f"bytes={arrived}-"]
    assert check_model(known(model, folder)).state == "present"


def test_a_server_without_ranges_sends_all_again(hub, model, folder):
    hub.has_ranges, hub.cuts = False, 1
    assert fetched(known(model, folder)) == ["fetched", "fetched"]


def test_other_bytes_than_those_that_are_named_never_come_into_place(hub, model, folder):
    right = (folder / WEIGHTS).read_bytes()
    hub.replaced[WEIGHTS] = right[:-1] + bytes([right[-1] ^ 1])
    refused(known(model, folder), "it was deleted; fetch it again")
    assert check_model(model).state == "missing"
    assert not left_over(model)
    refused(model, "it was deleted; fetch it again")  # the hub's own name of it is enough to see that
    hub.replaced.clear()
    assert fetched(model) == ["present", "fetched"]


def test_other_bytes_than_git_names_never_come_into_place(hub, model, folder):
    hub.replaced = {CONFIG: b"x" * (folder / CONFIG).stat().st_size}
    refused(model, f"{CONFIG} arrived with sha256")
    assert check_model(model).state == "missing"


def test_a_file_that_the_table_knows_otherwise_is_not_downloaded(hub, model, folder):
    size = (folder / WEIGHTS).stat().st_size
    refused(known(model, folder, size=size + 1), f"the hub offers {size} bytes, and {size + 1} are known")
    refused(known(model, folder, sha256="0" * 64), "and " + "0" * 64 + " is known")
    assert not [path for path, _, _ in hub.sent if path == WEIGHTS]


def test_a_file_that_the_lock_knows_otherwise_is_not_downloaded(hub, model):
    fetch_model(model, lambda _: None)
    lock = locate_repository(model) / LOCK_NAME
    tree = json.loads(lock.read_text())
    tree["commits"][model.revision][WEIGHTS]["sha256"] = "0" * 64
    lock.write_text(json.dumps(tree))
    assert check_model(model).state == "damaged"
    refused(model, "and " + "0" * 64 + " is known")


def test_more_bytes_than_announced_are_not_written(hub, model, folder):
    hub.replaced[WEIGHTS] = (folder / WEIGHTS).read_bytes() + b"x" * 5000
    hub.says_size = False  # of the body; the hub's answer to HEAD carries it in its redirect
    with serving(type("Cdn", (Handler,), {"hub": hub})) as hub.cdn:
        refused(model, "the hub sends more than the")
    assert not left_over(model)
    assert check_model(model).state == "missing"


def test_files_are_bounded_before_they_are_asked_for(hub, model, monkeypatch):
    monkeypatch.setattr(fetching, "MAX_FILE_BYTES", 1000)
    refused(model, "more than the 1000 that are allowed")
    monkeypatch.setattr(fetching, "MAX_FILE_BYTES", 1 << 40)
    monkeypatch.setattr(fetching, "SPARE_BYTES", 1 << 60)
    refused(model, "make room, or set HF_HOME")


def test_a_token_goes_to_the_hub_and_not_where_it_redirects(hub, model, monkeypatch, capfd):
    monkeypatch.setenv("HF_TOKEN", "hf_never_shown")
    hub.cuts = 1
    with serving(type("Cdn", (Handler,), {"hub": hub})) as hub.cdn:
        assert fetched(model) == ["fetched", "fetched"]
    assert [owner for path, _, owner in hub.sent if path == CONFIG] == ["Bearer hf_never_shown"]
    assert {owner for path, _, owner in hub.sent if path == WEIGHTS} == {""}
    shown = "".join(capfd.readouterr())
    assert "hf_never_shown" not in shown
    assert "Signature" not in shown
    assert "127.0.0.1" not in shown


def test_what_the_hub_refuses_is_told_with_the_remedy(hub, model, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_never_shown")
    hub.gated.add(NAME)
    assert "hf_never_shown" not in refused(
        model, "is gated: accept its licence on its page of the hub, and set HF_TOKEN"
    )
    hub.gated.clear()
    refused(replace(model, repository="someone/else"), "shows it only to a token (HF_TOKEN)")
    refused(replace(model, revision="a" * 40), "the hub knows no 'aaaa")
    refused(replace(model, revision="v9"), "the hub knows no 'v9' of this model")
    missing = replace(model, files=(WeightFile("tokenizer.json"),))
    refused(missing, "holds no tokenizer.json: is the revision right?")
    hub.status = 503
    told = refused(model, f"{CONFIG} cannot be fetched")
    assert told.endswith("run the same command again")
    assert "127.0.0.1" not in told
    hub.status = 200
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert "127.0.0.1" not in refused(model, f"the hub cannot be reached to fetch {CONFIG} (OfflineModeIsEnabled")


def test_a_slow_hub_is_not_waited_for_without_end(hub, model, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_ETAG_TIMEOUT", 0.2)
    hub.silent_s = 1.0
    refused(model, "run the same command again")


def test_weights_that_another_program_fetches_are_left_to_it(model):
    with pytest.raises(InputError, match="is not fetched here: see its own process"):
        fetch_model(replace(model, files=(), loaded_by="its own process"), print)


def test_two_fetches_of_one_file_do_not_write_into_each_other(hub, model, folder):
    partial = locate_repository(model) / "blobs" / f"{hash_file(folder / WEIGHTS)}.partial"
    partial.parent.mkdir(parents=True)
    with fetching._PartialFile(partial, 10, "tiny"):
        refused(model, "is being fetched by another process")
    assert fetched(model) == ["present", "fetched"]


@pytest.mark.parametrize("rest", [b"", b"damaged"])
def test_damage_is_found_and_fetched_again(hub, model, folder, rest):
    fetch_model(model, lambda _: None)
    assert check_model(model).state == "present"
    for name in (CONFIG, WEIGHTS):
        own = blob(model, name)
        right = own.read_bytes()
        own.write_bytes(right[:-7] + rest)
        states = {file.name: file.state for file in check_model(model).files}
        assert states[name] == "damaged"
        assert fetched(model).count("fetched") == 1
        assert check_model(model).state == "present"
    assert not left_over(model)


def test_what_another_tool_put_into_the_cache_is_held_to_its_name_there(hub, model, folder):
    """`hf download` leaves no lock; the cache names files by their hashes."""
    import huggingface_hub

    for name in (CONFIG, WEIGHTS):
        huggingface_hub.hf_hub_download(NAME, name, revision=model.revision)
    assert [file.detail for file in check_model(model).files] == [
        "git's hash, its name in the cache",
        "sha256 of its name in the cache",
    ]
    blob(model, CONFIG).write_bytes(b"{}")
    assert check_model(model).state == "damaged"
    assert fetched(model) == ["fetched", "present"]
    assert {file.detail for file in check_model(model).files} == {"sha256 of the lock"}
    assert {file.detail for file in check_model(known(model, folder)).files} == {
        "sha256 of the lock",
        "sha256 of the catalogue",
    }


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "other"}', '{"format": "tableverse-weights-1"}'])
def test_a_lock_that_cannot_be_read_is_no_lock_by_silence(hub, model, text):
    fetch_model(model, lambda _: None)
    (locate_repository(model) / LOCK_NAME).write_text(text)
    with pytest.raises(ModelAccessError, match=f"{LOCK_NAME} cannot be read .*: delete it, and fetch tiny again"):
        check_model(model)


def test_the_lock_keeps_what_was_fetched_of_every_commit(hub, model, folder, tmp_path):
    fetch_model(model, lambda _: None)
    other = replace(model, revision=hub.models[NAME].commit(folder))
    fetch_model(other, lambda _: None)
    assert {*read_lock(model)} == {model.revision, other.revision}


def test_the_table_is_one():
    assert len({model.name for model in CATALOGUE}) == len({model.repository for model in CATALOGUE}) == len(CATALOGUE)
    assert {*DEFAULT_WEIGHTS} == {model.backend for model in CATALOGUE}
    for model in CATALOGUE:
        assert not model.revision or GIT_HASH.fullmatch(model.revision)
        assert all(file.name.endswith((".safetensors", ".json")) for file in model.files), "others may hold code"
        assert not model.files or model.revision, f"{model.name} is fetched at a commit that is pinned"
        for file in model.files:
            assert not file.sha256 or SHA256.fullmatch(file.sha256)
            assert file.size is None or 0 < file.size <= fetching.MAX_FILE_BYTES
        if model.files:
            (weights,) = [file for file in model.files if file.name == WEIGHTS]
            assert weights.size
            assert weights.sha256
    assert BY_REPOSITORY["facebook/sam3"].is_gated
