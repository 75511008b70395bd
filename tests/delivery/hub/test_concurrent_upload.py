"""`tableverse publish` where others write too: edited cards, two publishers, leftovers; and Hubs without Xet."""

import os
import socket
import subprocess
import sys

import huggingface_hub.constants
import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.delivery.hub.upload import UploadOptions, upload
from tableverse_factory.delivery.hub.upload_set import collect_upload_set
from tests.helpers.hub_server import TOKEN, Handler, HubServer
from tests.helpers.public_dataset import tree_of

# huggingface_hub hands files to httpx2 in a way that httpx2 no longer likes.
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")

NAME = "me/table-tops"
EDITED = b"---\nlicense: mit\nconfigs: []\n---\n# Mine, with a DOI\n"
TOKEN_OF_XET = f"GET /api/datasets/{NAME}/xet-write-token/main"


def publish(run, dataset, *options: str) -> str:
    code, said, errors = run("publish", dataset, "--repo", NAME, "--upload", *options)
    assert (code, errors) == (0, "")
    return str(said)


@pytest.mark.heavy
def test_a_hub_without_xet_is_written_to_without(hub, dataset, run):
    """With hf_xet installed, which comes with huggingface_hub, and nothing set: as users have it."""
    publish(run, dataset)
    assert hub.asked[TOKEN_OF_XET] == 1
    assert huggingface_hub.constants.HF_HUB_DISABLE_XET is False


@pytest.mark.heavy
def test_a_xet_storage_that_does_not_answer_ends_in_one_line(hub, dataset, tmp_path):
    """A real process: what waits in it is native, and must not keep it from ending."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        hub.storage_of_xet = f"http://127.0.0.1:{silent.getsockname()[1]}"
        code = (
            "import tableverse_factory.delivery.hub.upload as upload; from tableverse_factory.cli.main import main; "
            "upload.TIMEOUT_S = 1; main()"
        )
        settings = {"HF_ENDPOINT": hub.endpoint, "HF_TOKEN": TOKEN, "HF_HOME": str(tmp_path / "h")}
        process = subprocess.run(
            [sys.executable, "-c", code, "publish", str(dataset), "--repo", NAME, "--upload"],
            env={**os.environ, **settings},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert hub.asked[TOKEN_OF_XET] == 2, "ours, and the one of hf_xet"
    assert (process.returncode, process.stderr.count("\n")) == (1, 2)
    assert "gives no answer within 1 s" in process.stderr
    assert "HF_HUB_DISABLE_XET=1" in process.stderr
    assert "0 %  Card, plan and record" in process.stdout, "what is done is said before it"


@pytest.mark.heavy
def test_a_card_that_was_edited_on_the_hub_is_kept(hub, dataset, run):
    publish(run, dataset)
    there = hub.repositories[NAME]
    ours = there.files["README.md"]
    there.commit("Update README.md", {**there.files, "README.md": EDITED})
    assert "README.md was not written by publish, or was edited" in publish(run, dataset)
    assert there.files["README.md"] == EDITED
    publish(run, dataset, "--card")
    assert there.files["README.md"] == ours


@pytest.mark.heavy
def test_a_card_that_was_there_first_is_kept(hub, dataset, run):
    begin(hub, {"README.md": EDITED})
    with pytest.raises(BuildError, match="private on the Hub"):
        upload(collect_upload_set(dataset), NAME, UploadOptions(public=True), print)
    said = publish(run, dataset)
    assert "it is kept (--card replaces it)" in said
    assert hub.repositories[NAME].files["README.md"] == EDITED
    assert on_the_hub(hub).keys() == tree_of(dataset, left_behind(dataset)).keys()


@pytest.mark.heavy
def test_our_own_card_grows_with_the_dataset(hub, dataset, run):
    scenes = dataset / "scenes" / "shard-00001.parquet"
    data = scenes.read_bytes()
    scenes.unlink()
    publish(run, dataset, "--unfinished")
    before = hub.repositories[NAME].files["README.md"]
    scenes.write_bytes(data)
    assert "kept" not in publish(run, dataset)
    assert hub.repositories[NAME].files["README.md"] != before


@pytest.mark.heavy
def test_two_that_publish_under_one_empty_name_do_not_mix(hub, dataset, run):
    """The other one's first commit falls between our look and our first commit."""
    theirs = {"run.json": b'{"seed": 7}', "plan.parquet": b"theirs"}
    meanwhile(hub, lambda files: {**files, **theirs})
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert code == 1
    assert "holds another dataset" in errors
    assert {name: data for name, data in on_the_hub(hub).items() if name in theirs} == theirs
    assert len(on_the_hub(hub)) == 2


@pytest.mark.heavy
def test_a_dataset_that_takes_our_place_meanwhile_is_not_replaced(hub, dataset, run):
    """--replace speaks of what was there when it was typed."""
    meanwhile(hub, lambda _: {"run.json": b'{"seed": 7}'}, after=1)
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload", "--replace")
    assert code == 1
    assert "holds another dataset" in errors
    assert on_the_hub(hub) == {"run.json": b'{"seed": 7}'}


@pytest.mark.heavy
def test_a_card_that_is_edited_meanwhile_is_kept_and_the_rest_arrives(hub, dataset, run):
    meanwhile(hub, lambda files: {**files, "README.md": EDITED}, after=1)
    assert "inspecting it again" in publish(run, dataset)
    assert hub.repositories[NAME].files["README.md"] == EDITED
    assert on_the_hub(hub) == tree_of(dataset, left_behind(dataset))


@pytest.mark.heavy
def test_files_that_the_dataset_no_longer_has_are_taken_away(hub, dataset, run):
    publish(run, dataset)
    there = hub.repositories[NAME]
    strays = ("trajectories/shard-00000.parquet", "scenes/shard-00009.parquet", "merged/objects.parquet")
    others = {"scenes/notes.md": b"not ours", "LICENSE": b"CC"}
    there.commit("before", {**there.files, **dict.fromkeys(strays, b"stray"), **others})
    said = publish(run, dataset)
    assert "deleted, because the dataset does not have it: merged/objects.parquet, scenes/shard-00009.parquet" in said
    assert on_the_hub(hub) == {**tree_of(dataset, left_behind(dataset)), **others}


@pytest.mark.heavy
def test_an_unfinished_copy_takes_no_finished_shard_away(hub, dataset, run):
    publish(run, dataset)
    whole = on_the_hub(hub)
    (dataset / "scenes" / "shard-00001.parquet").unlink()
    publish(run, dataset, "--unfinished")
    assert on_the_hub(hub) == whole | {name: data for name, data in tree_of(dataset).items() if name in whole}


@pytest.mark.heavy
def test_our_own_faults_are_not_laid_at_the_hubs_door(hub, dataset):
    def broken(_: str) -> None:
        raise KeyError("a bug of ours")

    with pytest.raises(KeyError, match="a bug of ours"):
        upload(collect_upload_set(dataset), NAME, UploadOptions(), broken)


@pytest.mark.heavy
def test_a_file_that_goes_while_it_is_sent_is_named(hub, dataset):
    contents = collect_upload_set(dataset)
    (dataset / "mjcf" / "shard-00001.tar").unlink()
    with pytest.raises(BuildError, match=r"shard-00001\.tar is gone since the upload began"):
        upload(contents, NAME, UploadOptions(), print)


def begin(hub: HubServer, files: dict[str, bytes]) -> None:
    from huggingface_hub import HfApi

    HfApi(endpoint=hub.endpoint, token=TOKEN).create_repo(NAME, repo_type="dataset", private=True)
    hub.repositories[NAME].commit("initial commit", {**hub.repositories[NAME].files, **files})


def meanwhile(hub: HubServer, change, after: int = 0) -> None:
    """Somebody else commits once, just before our commit that follows so many."""
    left = [None]

    def fault(_: Handler, method: str, path: str) -> bool:
        there = hub.repositories.get(NAME)
        if left and method == "POST" and path.endswith("/commit/main") and there and len(there.messages) == after:
            left.pop()
            there.commit("theirs", change(there.files))
        return False

    hub.fault = fault


def left_behind(dataset) -> tuple[str, ...]:
    """What of the folder is not of the dataset."""
    return tuple(name for name in tree_of(dataset) if (dataset / name).read_bytes() == b"not of the dataset")


def on_the_hub(hub: HubServer) -> dict[str, bytes]:
    files = hub.repositories[NAME].files
    return {name: data for name, data in files.items() if name not in (".gitattributes", "README.md")}
