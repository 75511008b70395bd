"""`tableverse publish` against a server that speaks the Hub's protocol: what goes, what must not, and going on."""

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.parquet import encode_parquet
from tableverse_factory.dataset.card_yaml import make_front_matter
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.hub import upload
from tableverse_factory.delivery.hub.upload_set import collect_upload_set
from tests.helpers.hub_server import TOKEN, Handler, sha256
from tests.helpers.public_dataset import tree_of, write_public_dataset

# huggingface_hub hands files to httpx2 in a way that httpx2 no longer likes.
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")

NAME = "me/table-tops"
LEFT_BEHIND = (".stages/observe/x", ".work/lock", ".cache/huggingface/x", "notes.txt", "mjcf/shard-00009.tar.partial")


def on_the_hub(hub) -> dict[str, bytes]:
    files = hub.repositories[NAME].files
    return {name: data for name, data in files.items() if name not in (".gitattributes", "README.md")}


def test_without_upload_nobody_is_asked(hub, dataset, run):
    before = tree_of(dataset)
    code, said, errors = run("publish", dataset, "--repo", NAME)
    assert (code, errors) == (0, "")
    assert f"{hub.endpoint}/datasets/{NAME}, private" in said
    assert "6 scenes, 6 of them with files" in said
    assert "licences: CC-BY-4.0 (6)" in said
    assert "not permissive: 0 scenes" in said
    assert f"tableverse publish {dataset} --repo {NAME} --upload" in said
    assert not hub.asked
    assert tree_of(dataset) == before


@pytest.mark.heavy
def test_what_was_uploaded_is_the_dataset_and_nothing_else(hub, dataset, run):
    before = tree_of(dataset)
    code, said, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert (code, errors) == (0, "")
    assert hub.repositories[NAME].private is True
    assert on_the_hub(hub) == tree_of(dataset, LEFT_BEHIND)
    assert hub.repositories[NAME].messages == ["Card, plan and record", "Shards 0 to 2 of 3"]
    assert tree_of(dataset) == before, "nothing is written beside the dataset"
    assert TOKEN not in said + errors
    assert not hub.tokens_seen


@pytest.mark.heavy
def test_the_card_is_what_the_hub_reads_tables_by(hub, dataset, run):
    run("publish", dataset, "--repo", NAME, "--upload")
    files = hub.repositories[NAME].files
    head = yaml.safe_load(files["README.md"].decode().split("---\n")[1])
    assert head["license"] == "cc-by-4.0"
    assert head["size_categories"] == ["n<1K"]
    assert head["task_categories"] == ["robotics"]
    assert [config["config_name"] for config in head["configs"]] == ["scenes", "objects", "tasks"]
    for config in head["configs"]:
        pattern = Path(config["data_files"][0]["path"])
        assert len([name for name in files if Path(name).match(str(pattern))]) == 3


@pytest.mark.heavy
def test_a_card_with_a_head_of_its_own_is_kept(hub, dataset, run):
    (dataset / "README.md").write_text("---\nlicense: mit\nconfigs: []\n---\n# My words\n")
    run("publish", dataset, "--repo", NAME, "--upload")
    assert hub.repositories[NAME].files["README.md"] == (dataset / "README.md").read_bytes()


@pytest.mark.heavy
def test_again_sends_nothing(hub, dataset, run):
    run("publish", dataset, "--repo", NAME, "--upload")
    puts, commits = dict(hub.put), len(hub.repositories[NAME].commits)
    assert run("publish", dataset, "--repo", NAME, "--upload")[0] == 0
    assert (dict(hub.put), len(hub.repositories[NAME].commits)) == (puts, commits)


@pytest.mark.slow  # builds are killed in the fast run
@pytest.mark.heavy
def test_killed_in_the_middle_it_goes_on_with_what_is_missing(hub, tmp_path):
    """A real process, and a real kill -9 while a file is under way in the second commit of shards."""
    out = write_public_dataset(tmp_path / "out", shards=20, scenes=1)
    stuck = out / "mjcf" / "shard-00018.tar"
    waiting = sha256(stuck.read_bytes())
    under_way = []

    def never(handler: Handler, method: str, path: str) -> bool:
        if method == "PUT" and path.endswith(waiting):
            under_way.append(path)
            time.sleep(60)
        return bool(method == "PUT" and path.endswith(waiting))

    hub.fault = never
    code = "from tableverse_factory.cli.main import main; main()"
    command = [sys.executable, "-c", code, "publish", str(out), "--repo", NAME, "--upload"]
    settings = {
        "HF_ENDPOINT": hub.endpoint,
        "HF_TOKEN": TOKEN,
        "HF_HOME": str(tmp_path / "h"),
    }
    process = subprocess.Popen(command, env={**os.environ, **settings}, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    until = time.monotonic() + 120
    while not under_way and process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    time.sleep(0.3)  # its neighbours arrive
    process.send_signal(signal.SIGKILL)
    said, errors = process.communicate()
    assert process.returncode == -signal.SIGKILL, (said, errors)
    assert hub.repositories[NAME].messages == ["Card, plan and record", "Shards 0 to 15 of 20"]
    half = open_dataset(f"hf://datasets/{NAME}")
    assert half.scenes.count_rows() == 16, "what is there is an unfinished dataset"

    hub.fault, arrived = None, dict(hub.put)
    assert waiting not in arrived
    process = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert on_the_hub(hub) == tree_of(out)
    assert all(hub.put[oid] == arrived[oid] for oid in arrived), "what had arrived was not sent again"
    assert hub.put[waiting] == 1
    assert TOKEN not in process.stdout + process.stderr + said.decode() + errors.decode()


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda out: (out / "scenes" / "shard-00001.parquet").unlink(), "1 of 3 shards are missing"),
        (lambda out: write_public_dataset(out, 3, licence=None), "6 scenes may not be passed on (6 unknown)"),
        (lambda out: write_public_dataset(out, 3, licence="CC-BY-ND-4.0"), "(6 no-derivatives)"),
        (lambda out: write_public_dataset(out, 3, licence="all rights reserved"), "(6 restricted)"),
        (lambda out: (out / "tasks" / "shard-00001.parquet").unlink(), "shard-00001.parquet is damaged"),
        (lambda out: os.truncate(out / "mjcf" / "shard-00002.tar", 20_480), "shard-00002.tar is damaged"),
        (lambda out: (out / "run.json").unlink(), "run.json"),
    ],
)
def test_what_must_not_be_published_is_not(hub, dataset, run, change, said):
    change(dataset)
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert (code, errors.count("\n")) == (1, 2)
    assert said in errors
    assert not hub.asked


def test_share_alike_goes_and_is_counted(hub, dataset, run):
    write_public_dataset(dataset, 3, licence="CC-BY-SA-4.0")
    code, said, _ = run("publish", dataset, "--repo", NAME)
    assert code == 0
    assert "not permissive: 6 scenes (6 share-alike)" in said


@pytest.mark.heavy
def test_a_build_that_names_its_machine_is_exported_first(hub, dataset, run, tmp_path):
    path = dataset / "scenes" / "shard-00000.parquet"
    table = pq.read_table(path, partitioning=None)
    rows = table.to_pylist()
    rows[0]["uri"] = "/home/me/secret/photo"
    path.write_bytes(encode_parquet(pa.Table.from_pylist(rows, schema=table.schema)))
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert code == 1
    assert "1 rows or values name files or addresses of this machine" in errors
    assert f"tableverse export {dataset} {dataset}-public --profile permissive" in errors
    assert not hub.asked
    assert run("export", dataset, f"{dataset}-public")[0] == 0
    assert run("publish", f"{dataset}-public", "--repo", NAME, "--upload")[0] == 0


@pytest.mark.heavy
def test_an_unfinished_dataset_goes_where_that_is_asked_for_and_is_finished_later(hub, dataset, run):
    scenes = dataset / "scenes" / "shard-00001.parquet"
    data = scenes.read_bytes()
    scenes.unlink()
    assert run("publish", dataset, "--repo", NAME, "--upload", "--unfinished")[0] == 0
    assert open_dataset(f"hf://datasets/{NAME}").shards == (0, 2)
    scenes.write_bytes(data)
    assert run("publish", dataset, "--repo", NAME, "--upload")[0] == 0
    assert open_dataset(f"hf://datasets/{NAME}").shards == (0, 1, 2)
    assert all(count == 1 for count in hub.put.values())


@pytest.mark.heavy
def test_another_dataset_is_replaced_only_where_that_is_asked_for(hub, dataset, run, tmp_path):
    run("publish", dataset, "--repo", NAME, "--upload")
    other = write_public_dataset(tmp_path / "other", shards=1)
    (other / "run.json").write_text((other / "run.json").read_text().replace('"seed": 0', '"seed": 7'))
    before = dict(hub.repositories[NAME].files)
    code, _, errors = run("publish", other, "--repo", NAME, "--upload")
    assert code == 1
    assert "holds another dataset (seed differ)" in errors
    assert hub.repositories[NAME].files == before
    assert run("publish", other, "--repo", NAME, "--upload", "--replace")[0] == 0
    assert on_the_hub(hub) == tree_of(other)


@pytest.mark.heavy
def test_what_somebody_else_keeps_there_is_left_alone(hub, dataset, run):
    run("publish", dataset, "--repo", NAME, "--upload")
    hub.repositories[NAME].commit("mine", {"thesis.tex": b"x"})
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload", "--replace")
    assert code == 1
    assert "holds something else (thesis.tex)" in errors


@pytest.mark.heavy
def test_what_is_public_stays_not_unnoticed(hub, dataset, run):
    assert run("publish", dataset, "--repo", NAME, "--upload", "--public")[0] == 0
    assert hub.repositories[NAME].private is False
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert code == 1
    assert "is public on the Hub: run again with --public" in errors


def failing(status: int, times: int, where: str, **headers: str):
    left = [None] * times

    def fault(handler: Handler, method: str, path: str) -> bool:
        if where not in f"{method} {path}" or not left:
            return False
        left.pop()
        handler.json(status, {"error": f"no: {handler.hub.endpoint}/x?sig=abc hf_secretsecret"}, headers)
        return True

    return fault


@pytest.mark.heavy
@pytest.mark.parametrize(
    "fault",
    [
        failing(500, 2, "/commit/main"),
        failing(429, 1, "/api/repos/create", **{"Retry-After": "0"}),
        *(
            pytest.param(fault, marks=pytest.mark.slow)
            for fault in (
                failing(409, 2, "/commit/main"),
                failing(503, 2, "/api/repos/create"),
                failing(502, 1, "/tree/"),
            )
        ),
    ],
)
def test_a_hub_that_is_busy_is_asked_again(hub, dataset, run, fault):
    hub.fault = fault
    assert run("publish", dataset, "--repo", NAME, "--upload")[0] == 0
    assert on_the_hub(hub) == tree_of(dataset, LEFT_BEHIND)
    assert all(count == 1 for count in hub.put.values())


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (failing(401, 99, "POST /api/repos/create"), "the Hub does not know the token: set HF_TOKEN, or log in"),
        (failing(403, 99, "POST /api/repos/create"), "the token may not do this: an upload needs write access"),
        (failing(403, 99, "PUT /storage"), "the token may not do this"),
        (failing(404, 99, "/preupload/"), "there is no such dataset"),
        (failing(413, 99, "/commit/main"), "a file or a commit too large"),
        (failing(500, 99, "/commit/main"), "the Hub answers 500"),
        (failing(429, 99, "/commit/main", **{"Retry-After": "999"}), "the Hub asks to slow down"),
    ],
)
def test_what_the_hub_refuses_is_one_line_without_secrets(hub, dataset, run, fault, said):
    hub.fault = fault
    code, out, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert (code, errors.count("\n")) == (1, 2)
    assert errors.startswith(f"error: {NAME}: ")
    assert said in errors
    assert "run the same command again" in errors
    for secret in (TOKEN, "hf_secret", "sig=", "Signature"):
        assert secret not in out + errors


@pytest.mark.heavy
def test_without_a_token_it_says_where_one_comes_from(hub, dataset, run, monkeypatch):
    monkeypatch.delenv("HF_TOKEN")
    code, _, errors = run("publish", dataset, "--repo", NAME, "--upload")
    assert code == 1
    assert "set HF_TOKEN, or log in with `hf auth login`" in errors


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["tables", "a/b/c", "../x", "me/..", "me/x y", "me/x.git", "me/\x1b[2J", "-me/x", ""])
def test_a_name_that_is_none_is_refused(hub, dataset, run, name):
    code, _, errors = run("publish", dataset, f"--repo={name}", "--upload")
    assert code == 1
    assert "give OWNER/NAME" in errors
    assert all(line.isprintable() for line in errors.splitlines())
    assert not hub.asked


def test_without_the_library_it_says_what_to_install(dataset, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for command in (("publish", dataset, "--repo", NAME), ("query", f"hf://datasets/{NAME}")):
        code, _, errors = run(*command)
        assert code == 1
        assert "pip install 'tableverse-factory[hub]'" in errors


@pytest.mark.heavy
def test_large_datasets_become_many_commits_of_whole_shards(dataset, monkeypatch):
    monkeypatch.setattr(upload, "MAX_BYTES_A_COMMIT", 1)
    commits = dict(upload._plan_commits(collect_upload_set(dataset)))
    assert list(commits) == ["Card, plan and record", "Shard 0 of 3", "Shard 1 of 3", "Shard 2 of 3"]
    assert {name.rpartition("/")[2].partition(".")[0] for name in commits["Shard 1 of 3"]} == {"shard-00001"}
    assert commits["Shard 1 of 3"][-1].startswith("scenes/")


@pytest.mark.parametrize(
    ("licences", "head"),
    [
        (["CC BY 4.0"], {"license": "cc-by-4.0"}),
        (["CC-BY-4.0", "CC0-1.0", "CC-BY-4.0"], {"license": ["cc-by-4.0", "cc0-1.0"]}),
        (["ODbL-1.0"], {"license": "odbl"}),
        (["CC0", "CC0-1.0"], {"license": "cc0-1.0"}),
        (["CC-BY-4.0", "my own: terms\n---"], {"license": "other", "license_name": "stated-for-each-scene"}),
        ([""], {"license": "other", "license_name": "stated-for-each-scene"}),
    ],
)
def test_licences_are_named_as_the_hub_names_them(licences, head):
    text = make_front_matter(2000, licences, ["scenes"])
    found = yaml.safe_load(text.removeprefix("---\n").removesuffix("---"))
    assert {key: found[key] for key in found if key.startswith("license")} == head
    assert found["size_categories"] == ["1K<n<10K"]


@pytest.mark.heavy
def test_a_scene_opens_from_the_hub_by_its_own_bytes(hub, dataset, run, tmp_path):
    run("publish", dataset, "--repo", NAME, "--upload")
    hub.sent.clear()
    scene = open_dataset(f"hf://datasets/{NAME}").scene("s-2-1")
    assert scene.files() == open_dataset(dataset).scene("s-2-1").files()
    tar = sha256((dataset / "mjcf" / "shard-00002.tar").read_bytes())
    assert hub.sent[f"/cdn/{tar}"] == scene.row["tar_size"]
    assert not hub.tokens_seen, "where the Hub sends us on to is not told the token"
    assert run("extract", f"hf://datasets/{NAME}", tmp_path / "scene", "--scene", "s-0-1")[0] == 0
    assert "s-1-0" in run("query", f"hf://datasets/{NAME}@main", "--where", "shard = 1")[1]


@pytest.mark.heavy
def test_what_is_pushed_later_does_not_mix_into_what_was_opened(hub, dataset, run):
    run("publish", dataset, "--repo", NAME, "--upload")
    opened, found = pickle.loads(pickle.dumps(open_dataset(f"hf://datasets/{NAME}"))), hub.repositories[NAME]
    first = found.commits[-1][0]
    found.commit("gone", {".gitattributes": b"", "run.json": b"{}"})
    assert opened.scene("s-1-0").files() == open_dataset(dataset).scene("s-1-0").files()
    assert opened.scenes.count_rows() == 6
    assert open_dataset(f"hf://datasets/{NAME}@{first}").scene("s-1-1").model().nbody == 3
    with pytest.raises((InputError, StoreError)):
        open_dataset(f"hf://datasets/{NAME}").scene("s-1-0")


@pytest.mark.parametrize(
    ("address", "said"),
    [
        (f"hf://datasets/{NAME}", "there is no such dataset, or the token may not see it"),
        (f"hf://{NAME}", "give hf://datasets/OWNER/NAME"),
        ("hf://datasets/me", "give hf://datasets/OWNER/NAME"),
        (f"hf://datasets/{NAME}@../x", "after @ stands a branch"),
        ("hf://datasets/me/\x1b[2J", "give hf://datasets/OWNER/NAME"),
    ],
)
def test_an_address_on_the_hub_that_is_none_is_said(hub, address, said, run):
    code, _, errors = run("query", address)
    assert (code, errors.count("\n")) == (1, 2)
    assert said in errors
