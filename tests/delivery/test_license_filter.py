"""A dataset that may be passed on: only what its profile allows, every scene byte for byte, also after a kill."""

import hashlib
import json
import re

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from schemas.config import Config
from schemas.scene import Certificate, ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TIMINGS
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.card import make_dataset_card
from tableverse_factory.dataset.committed_rows import read_columns
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.journals import WORK
from tableverse_factory.dataset.judge_summary import JUDGEMENT_COLUMNS, summarize_judgements
from tableverse_factory.dataset.licences import LicenceVerdict
from tableverse_factory.dataset.shard_plan import Plan, write_plan
from tableverse_factory.dataset.shards import TarShard, shard_path
from tableverse_factory.delivery.hub.upload_set import collect_upload_set
from tableverse_factory.delivery.license_filter import redact_config, redact_uri, write_filtered_dataset
from tableverse_factory.run_record import FORMAT, read_run, write_run
from workers.progress.build_state import read_build_state
from workers.state.lock import create_writer_lock

LICENCES = [
    ["CC0-1.0", "CC-BY-NC-4.0", None],
    ["All rights reserved"],
    ["CC-BY-SA-4.0", "MIT", "CC-BY-4.0", "CC0-1.0"],
]
LOST = "s-2-1"


@pytest.fixture
def dataset(tmp_path):
    out = tmp_path / "out"
    names = [[f"s-{shard}-{i}" for i in range(len(shard_of))] for shard, shard_of in enumerate(LICENCES)]
    for shard, licences in enumerate(LICENCES):
        _write_shard(out, shard, dict(zip(names[shard], licences, strict=True)))
    ids = tuple(name for of_shard in names for name in of_shard)
    shards = tuple(shard for shard, of_shard in enumerate(names) for _ in of_shard)
    write_plan(out / "plan.parquet", Plan(ids, ("capture",) * len(ids), shards))
    (out / "run.json").write_text(json.dumps({"format": FORMAT, "seed": 0, "fingerprint": "f" * 64}))
    return out


def _write_shard(out, number, licences, meshes=None):
    certificate = Certificate(0.001, *[0.0] * 6, (), (), (), True, False)
    scenes, tables = [], {"objects": (OBJECTS, []), "tasks": (TASKS, []), "timings": (TIMINGS, [])}
    path = shard_path(out, "mjcf", number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        tar = TarShard(file)
        for name, licence in licences.items():
            row = {"scene_id": name, "kind": "capture", "licence": licence, "shard": number, "status": "dropped"}
            row |= {"mesh_licences": (meshes or {}).get(name)}
            row |= {"reason": "duplicate", "detail": "same content as s-0-1 at /home/me/secret/s-0-1"}
            row |= {"recipe": '{"changes":["swap"],"donors":[{"scene_id":"s-0-1"}]}'}
            if name != LOST:
                files = (("meta.json", name.encode() * 900), ("scene.xml", b"<mujoco/>"))
                offset, size = tar.add(ExportedScene(name, files, certificate, {}, (), ()))
                row |= {"status": "done", "tar_offset": offset, "tar_size": size}
            scenes.append({**row, "uri": f"/home/me/secret/{name}", "source": f"by {name}", "stage": "export"})
            tables["objects"][1].append({"scene_id": name, "object_id": "obj_000"})
            tables["tasks"][1].append({"scene_id": name, "task_id": "task_000"})
            tables["timings"][1].append({"scene_id": name, "stage": "export", "cpu_s": 1.0, "wall_s": 1.0})
        tar.close()
    for table, (schema, rows) in {**tables, "scenes": (SCENES, scenes)}.items():
        write_atomic(shard_path(out, table, number), encode_parquet(build_table(rows, schema)))


@pytest.mark.heavy
def test_meshes_of_models_bind_a_scene_as_its_picture_does(dataset, tmp_path):
    meshes = {"s-2-2": ["MIT", "SAM License"], "s-2-3": ["MIT"]}
    _write_shard(dataset, 2, {f"s-2-{k}": licence for k, licence in enumerate(LICENCES[2])}, meshes)
    write_filtered_dataset(dataset, tmp_path / "public", "permissive")
    rows = {row["scene_id"]: row for row in open_dataset(tmp_path / "public").scenes.to_table().to_pylist()}
    assert set(rows) == {"s-0-0", "s-2-1", "s-2-3"}
    assert rows["s-2-3"]["mesh_licences"] == ["MIT"]
    card = make_dataset_card(dataset, read_run(dataset / "run.json"), range(3))
    assert "CC-BY-4.0; meshes: MIT, SAM License" in card
    assert collect_upload_set(dataset).verdicts[LicenceVerdict.UNKNOWN] == 2


def tree(folder):
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*.*")}


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("profile", "kept"),
    [
        ("permissive", ["s-0-0", "s-2-1", "s-2-2", "s-2-3"]),
        ("share-alike", ["s-0-0", "s-2-0", "s-2-1", "s-2-2", "s-2-3"]),
        ("non-commercial", ["s-0-0", "s-0-1", "s-2-0", "s-2-1", "s-2-2", "s-2-3"]),
    ],
)
def test_a_profile_decides_and_what_stays_behind_leaves_no_trace(dataset, tmp_path, profile, kept):
    result = write_filtered_dataset(dataset, tmp_path / "public", profile)
    assert (result.kept, result.done) == (len(kept), len(kept) - 1)
    assert sum(result.left_out.values()) == 8 - len(kept)
    before, after = open_dataset(dataset), open_dataset(tmp_path / "public")
    for table in ("scenes", "objects", "tasks"):
        assert sorted(set(getattr(after, table).to_table()["scene_id"].to_pylist())) == kept
    for name in kept:
        if name != LOST:
            assert after.scene(name).files() == before.scene(name).files()
    found = read_build_state(tmp_path / "public")
    assert (found.total, found.done, found.dropped, found.remaining) == (len(kept), len(kept) - 1, 1, 0)
    gone = {name for name in before.scenes.to_table()["scene_id"].to_pylist() if name not in kept}
    everything = b"".join(p.read_bytes() for p in (tmp_path / "public").rglob("*.*"))
    assert not any(name.encode() in everything for name in gone)
    assert b"/home/me" not in everything
    assert after.scenes.to_table()["detail"].null_count == len(kept)
    for path in (tmp_path / "public" / "scenes").iterdir():
        assert all("/" not in uri for uri in pq.read_table(path)["uri"].to_pylist())


@pytest.mark.heavy
@pytest.mark.parametrize("survivor", ["run.json", "scenes/shard-00000.parquet", "mjcf/shard-00001.tar"])
def test_a_killed_export_goes_on_to_the_same_bytes(dataset, tmp_path, survivor):
    write_filtered_dataset(dataset, tmp_path / "whole", "permissive")
    write_filtered_dataset(dataset, tmp_path / "killed", "permissive")
    order = ["plan.parquet", "run.json"]
    order += [f"{f}/shard-{n:05d}.{e}" for n in (0, 1) for f, e in _folders()]
    for name in [*order[order.index(survivor) + 1 :], "README.md"]:
        (tmp_path / "killed" / name).unlink()
    write_filtered_dataset(dataset, tmp_path / "killed", "permissive")
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")


def _folders():
    parquet = [(folder, "parquet") for folder in ("objects", "tasks", "timings", "scenes")]
    return [("mjcf", "tar"), *parquet]


@pytest.mark.heavy
@pytest.mark.parametrize("left", ["plan.parquet.partial", "run.json.partial", ".work/lock"])
def test_an_export_killed_before_it_began_is_begun_again(dataset, tmp_path, left):
    path = tmp_path / "public" / left
    path.parent.mkdir(parents=True)
    path.write_bytes(b"half")
    assert CliRunner().invoke(app, ["export", str(dataset), str(tmp_path / "public")]).exit_code == 0
    write_filtered_dataset(dataset, tmp_path / "fresh", "permissive")
    assert tree(tmp_path / "public") == tree(tmp_path / "fresh")


def test_an_export_goes_on_only_with_the_scenes_it_was_begun_with(dataset, tmp_path):
    write_filtered_dataset(dataset, tmp_path / "public", "permissive")
    shard_path(tmp_path / "public", "scenes", 1).unlink()
    path = shard_path(dataset, "scenes", 2)
    rows = pq.read_table(path, schema=SCENES).to_pylist()
    rows[0]["licence"], rows[2]["licence"] = rows[2]["licence"], rows[0]["licence"]  # as many scenes as before
    write_atomic(path, encode_parquet(build_table(rows, SCENES)))
    with pytest.raises(BuildError, match=r"the content of published\.rows differs"):
        write_filtered_dataset(dataset, tmp_path / "public", "permissive")


def test_two_exports_do_not_write_at_once(dataset, tmp_path):
    arguments = ["export", str(dataset), str(tmp_path / "public")]
    with create_writer_lock(tmp_path / "public" / WORK / "lock"):
        ended = CliRunner().invoke(app, arguments)
    assert ended.exit_code == 1
    assert "being written by process" in str(ended.exception)
    assert not (tmp_path / "public" / "run.json").exists()
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert not (tmp_path / "public" / WORK).exists()


@pytest.mark.parametrize(
    ("uri", "public"),
    [
        ("https://photos.org/a/p.png", "https://photos.org/a/p.png"),
        ("HTTP://photos.org:8080/a%20b.png?page=2#top", "http://photos.org:8080/a%20b.png"),
        ("https://u:pw@h.org/p.png?X-Amz-Signature=abc", "https://h.org/p.png"),
        ("https://u:p@w@h.org/p.png", "https://h.org/p.png"),
        ("https://u:p/w@h.org/p.png?key=1", ""),
        ("https://[broken/p.png", ""),
        ("file:///home/alice/secret/p.png", "p.png"),
        ("file:///home%2Falice%2Fp.png", "p.png"),
        ("s3://private-bucket/x", "x"),
        ("s3://private-bucket", ""),
        ("gs://key:secret@private/x.png?sig=1", "x.png"),
        ("C:\\Users\\alice\\p.png", "p.png"),
        ("\\\\server\\alice\\p.png", "p.png"),
        ("/home/alice/what?.png", "what?.png"),
        ("http:/home/alice/p.png", "p.png"),
        ("", ""),
    ],
)
def test_what_the_public_cannot_open_becomes_a_name(uri, public):
    assert redact_uri(uri) == public


@pytest.mark.parametrize(
    ("detector", "weights", "public"),
    [
        ("picture", "acme/net.onnx", "net.onnx"),
        ("ensemble", "acme/net.onnx", "net.onnx"),
        ("auto", "acme/net.onnx", "net.onnx"),
        ("grounding_dino", "acme/dino@v1", "acme/dino@v1"),
        ("grounding_dino", "/home/me/dino", "dino"),
    ],
)
def test_a_published_record_names_weights_of_the_hub_and_no_folder(detector, weights, public):
    section = {"detector": detector, "detector_weights": weights}
    assert redact_config({"perceive": section}) == {"perceive": {**section, "detector_weights": public}}


def test_the_record_of_a_published_dataset_names_no_place(dataset, tmp_path):
    curate = {"base_url": "https://models.intern.example/v1", "replay_dir": "/home/me/answers"}
    config = {**Config().model_dump(mode="json")}
    config["curate"] |= curate
    meshes = {
        "mesh_model": "sam3d",
        "mesh_command": ["/home/me/bin/python", "/home/me/sam3d.py", "--checkout", "sam3d"],
    }
    config["place"] |= meshes
    config["observe"] |= {"depth": "moge_2", "depth_weights": "Ruicheng/moge-2-vitl@v1"}
    config["perceive"] |= {"detector": "picture", "detector_weights": "acme/net.onnx"}
    write_run(dataset / "run.json", {**read_run(dataset / "run.json"), "config": config})
    write_filtered_dataset(dataset, tmp_path / "public", "permissive")
    record = read_run(tmp_path / "public" / "run.json")
    place = {**config["place"], "mesh_command": ["python", "…", "…", "…"]}
    perceive = {**config["perceive"], "detector_weights": "net.onnx"}
    expected = {**config, "curate": {**config["curate"], "base_url": "", "replay_dir": ""}, "place": place}
    expected["perceive"] = perceive
    assert record["config"] == expected
    Config.model_validate(record["config"])


@pytest.mark.parametrize(
    ("command", "public"),
    [
        (["env", "HTTPS_PROXY=http://user:hunter2@proxy:3128", "/home/alice/bin/python"], ["env", "…", "…"]),
        (["docker", "-v", "/home/alice:/data", "--server=10.1.2.3:99", "--token", "hunter2"], ["docker", *"…" * 5]),
        (["/home/alice/"], ["alice"]),
        (["alice@host:x"], ["…"]),
        (["KEY=hunter2"], ["…"]),
        (["http://user:hunter2@proxy:3128"], ["…"]),
        ([], []),
    ],
)
def test_of_a_command_only_the_program_is_passed_on(command, public):
    given = {"place": {"mesh_command": command}}
    assert redact_config(given) == {"place": {"mesh_command": public}}
    assert redact_config(redact_config(given)) == redact_config(given), "else publish refuses what export wrote"


@pytest.mark.parametrize(
    ("weights", "public"),
    [
        ("/home/alice/clients/acme/depth", "depth"),
        ("/home/alice/clients/acme/depth/", "depth"),
        ("./acme/depth", "depth"),
        ("clients/acme/depth", "depth"),
        ("~/depth", "depth"),
        ("facebook/sam3", "facebook/sam3"),
        ("facebook/sam3@refs/pr/1", "facebook/sam3@refs/pr/1"),
        ("", ""),
    ],
)
@pytest.mark.parametrize(("key", "backend"), [("depth", "moge_2"), ("segmenter", "sam3")])
def test_of_weights_on_the_disk_no_folder_is_passed_on(key, backend, weights, public):
    assert redact_config({key: backend, f"{key}_weights": weights}) == {key: backend, f"{key}_weights": public}
    assert redact_config({key: backend, f"{key}_weights": public}) == {key: backend, f"{key}_weights": public}


def test_what_is_unfinished_or_somebody_elses_is_left_alone(dataset, tmp_path):
    write_filtered_dataset(dataset, tmp_path / "public", "permissive")
    with pytest.raises(BuildError, match=r"published\.profile"):
        write_filtered_dataset(dataset, tmp_path / "public", "share-alike")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(BuildError, match="something else"):
        write_filtered_dataset(dataset, tmp_path / "mine", "permissive")
    shard_path(dataset, "scenes", 1).unlink()
    with pytest.raises(BuildError, match=r"not finished: .* or give --unfinished"):
        write_filtered_dataset(dataset, tmp_path / "other", "permissive")


def test_what_publish_says_of_an_unfinished_dataset_can_be_done(dataset, tmp_path, run):
    """Its rows name files of this machine, so it has to be exported, and then it is a whole dataset of its own."""
    shard_path(dataset, "scenes", 2).unlink()
    code, _, refused = run("publish", dataset, "--repo", "me/x", "--unfinished")
    command = re.search(r"`tableverse (export [^`]*)`", refused)
    assert (code, command is not None) == (1, True), refused
    code, said, complained = run(*command[1].split())
    assert (code, complained) == (0, ""), complained
    code, said, complained = run("publish", f"{dataset}-public", "--repo", "me/x")
    assert (code, complained) == (0, ""), complained
    assert "1 of 1 shard" in said


def test_without_a_finished_shard_there_is_nothing_to_export(dataset, tmp_path):
    for number in range(3):
        shard_path(dataset, "scenes", number).unlink()
    with pytest.raises(BuildError, match=r"3 of 3 shards are missing; build on first$"):
        write_filtered_dataset(dataset, tmp_path / "public", "permissive", unfinished=True)


def test_the_card_counts_verdicts_sources_and_models(dataset, tmp_path):
    write_filtered_dataset(dataset, tmp_path / "public", "permissive")
    card = (tmp_path / "public" / "README.md").read_text()
    assert "| permissive | 3 |" in card
    assert "| CC0-1.0 | permissive | 2 |" in card
    assert "| by s-0-0 | 1 |" in card
    assert "profile `permissive`" in card
    run = {"seed": 0, "fingerprint": "f" * 64}
    assert "| unknown | 7 |" in make_dataset_card(dataset, run, range(3))  # made before there were verdicts


def test_a_dataset_of_an_earlier_version_is_still_read(dataset):
    for number in range(3):
        path = shard_path(dataset, "scenes", number)
        table = pq.read_table(path)
        old = [name for name in table.column_names if not name.startswith(("judge_", "rules_", "licence_v"))]
        write_atomic(path, encode_parquet(table.select(old)))
    assert summarize_judgements(read_columns(dataset, "scenes", range(3), JUDGEMENT_COLUMNS)).judges == {"none": 7}
    assert "| unknown | 7 |" in make_dataset_card(dataset, {"seed": 0, "fingerprint": "f" * 64}, range(3))


def test_the_command_says_what_stayed_behind(dataset, tmp_path):
    ended = CliRunner().invoke(app, ["export", str(dataset), str(tmp_path / "public"), "--profile", "share-alike"])
    assert ended.exit_code == 0, ended.output
    assert "5 scenes, 4 of them with files" in ended.output
    assert "left out: 1 unknown" in ended.output
    assert CliRunner().invoke(app, ["export", str(dataset), str(tmp_path / "x"), "--profile", "all"]).exit_code == 2


def test_nothing_to_pass_on_is_an_error_that_says_where_licences_are_stated(dataset, tmp_path):
    for path in (dataset / "scenes").glob("*.parquet"):
        rows = pq.read_table(path).to_pylist()
        write_atomic(path, encode_parquet(build_table([{**row, "licence": None} for row in rows], SCENES)))
    ended = CliRunner().invoke(app, ["export", str(dataset), str(tmp_path / "public")])
    assert ended.exit_code == 1
    assert isinstance(ended.exception, InputError)
    assert "8 unknown. A licence is stated where the input lies: in source.json" in str(ended.exception)
    assert not (tmp_path / "public" / "run.json").exists(), "no empty dataset is left"
