"""A build accounts for every row, refuses what would mix two builds, and does again only what it is told to."""

import json
import os
import random
import signal
import tarfile
import time
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.tables import OBJECTS, SCENES, TASKS, TIMINGS
from tableverse_factory.core.errors import BuildError, InputError
from tests.helpers.builds import (
    Silent,
    build,
    crowd,
    digests,
    finish,
    kill,
    request,
    scenes,
    start,
    wait_until,
    write_manifest,
)
from workers.plan.invalidate import reopen_scenes
from workers.progress.build_state import read_build_state
from workers.run import run_build
from workers.state.lock import create_writer_lock

pytestmark = pytest.mark.heavy

MIXED = ["fine", "empty_1", "fine", "sad", "fine", "fell", "fine", "segfault", "fine", "raise", "escape", "fine"]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A finished build of the mixed manifest, and that manifest."""
    folder = tmp_path_factory.mktemp("mixed")
    manifest = write_manifest(folder / "images.parquet", MIXED)
    build(manifest, folder / "out")
    return manifest, folder / "out"


def test_every_row_ends_with_its_status(mixed):
    _, out = mixed
    rows = scenes(out)
    assert [row["scene_id"] for row in rows] == [f"scene_{i:03d}" for i in range(len(MIXED))]
    whys = [(row["status"], row["stage"], row["reason"] or row["error_kind"]) for row in rows]
    ends = dict(zip(MIXED, whys, strict=True))
    assert ends == {
        "fine": ("done", "pack", None),
        "empty_1": ("dropped", "look", "nothing_there"),
        "fell": ("dropped", "fall", "not_at_rest"),
        "sad": ("failed", "cut", "GeometryError"),
        "segfault": ("failed", "cut", "crash"),
        "raise": ("failed", "cut", "exception"),
        "escape": ("failed", "pack", "BuildError"),
    }
    assert {row["attempts"] for row in rows if row["error_kind"] != "crash"} == {1}
    assert next(row["attempts"] for row in rows if row["error_kind"] == "crash") == 2


def test_offsets_open_one_scene_alone(mixed):
    _, out = mixed
    for row in scenes(out):
        if row["status"] != "done":
            assert row["tar_offset"] is None
            continue
        with (out / "mjcf" / f"shard-{row['shard']:05d}.tar").open("rb") as file:
            file.seek(row["tar_offset"])
            piece = file.read(row["tar_size"])
        (out.parent / "one.tar").write_bytes(piece + bytes(1024))
        with tarfile.open(out.parent / "one.tar") as tar:
            assert tar.getnames() == [f"{row['scene_id']}/assets/pieces.bin", f"{row['scene_id']}/scene.xml"]


def test_tables_have_their_schemas_and_only_done_scenes_have_objects(mixed):
    _, out = mixed
    done = {row["scene_id"] for row in scenes(out) if row["status"] == "done"}
    for name, schema in {"scenes": SCENES, "objects": OBJECTS, "tasks": TASKS, "timings": TIMINGS}.items():
        tables = [pq.read_table(path) for path in sorted((out / name).glob("*.parquet"))]
        assert len(tables) == 3
        assert all(table.schema.equals(schema) for table in tables)
        if name in ("objects", "tasks"):
            assert {i for table in tables for i in table["scene_id"].to_pylist()} == done


def test_nothing_is_left_of_the_work_and_the_card_counts(mixed):
    _, out = mixed
    assert {path.name for path in out.iterdir()} == {
        "run.json", "plan.parquet", "scenes", "objects", "tasks", "timings", "mjcf", "README.md", ".stages",
    }  # fmt: skip
    card = (out / "README.md").read_text()
    assert "| done | 6 |" in card
    assert "| dropped | fall | not_at_rest | 1 |" in card
    assert "| CC0 | permissive | 6 |" in card


def test_run_json_says_what_decides_bytes_and_nothing_else(mixed):
    manifest, out = mixed
    record = json.loads((out / "run.json").read_text())
    assert record["config"]["run"]["shard_size"] == 4
    assert {"numpy", "mujoco", "coacd", "python"} <= set(record["versions"])
    assert str(manifest.parent) not in (out / "run.json").read_text()


def test_a_second_build_elsewhere_and_a_second_run_here_give_the_same_bytes(mixed):
    manifest, out = mixed
    build(manifest, out.parent / "again")
    assert digests(out.parent / "again") == digests(out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert build(manifest, out).signal == 0
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == before


def test_rejected_invalid_and_repeated_rows_are_rows(tmp_path):
    good = {"kind": "capture", "uri": "/x", "name": "fine"}
    records = [
        {"scene_id": "a", **good},
        {"scene_id": "b", **good, "rejected": "unreadable_color", "rejected_detail": "not a PNG"},
        {"scene_id": "../../x", **good},
        {"scene_id": "a", **good},
        {"scene_id": "c", **good, "kind": "video"},
        {"scene_id": "d", **good, "uri": None},
    ]
    pq.write_table(pa.Table.from_pylist(records, pa.schema([(k, pa.string()) for k in records[1]])), tmp_path / "m")
    build(tmp_path / "m", tmp_path / "out")
    rows = scenes(tmp_path / "out")
    assert [row["status"] for row in rows] == ["done"] + ["dropped"] * 5
    assert {row["stage"] for row in rows[1:]} == {"manifest"}
    reasons = [row["reason"] for row in rows[1:]]
    assert reasons == ["unreadable_color", "invalid_manifest_row", "duplicate_scene_id", *["invalid_manifest_row"] * 2]
    assert len({row["scene_id"] for row in rows}) == 6
    assert "../../x" in rows[2]["detail"]
    assert "row 3" in rows[3]["detail"]
    assert "row 0" in rows[3]["detail"]


def test_a_manifest_that_is_none_is_a_clear_error(tmp_path):
    (tmp_path / "text").write_text("no parquet")
    with pytest.raises(InputError, match="no Parquet file"):
        build(tmp_path / "text", tmp_path / "out")
    with pytest.raises(InputError, match="does not exist"):
        build(tmp_path / "absent.parquet", tmp_path / "out")


def test_an_empty_manifest_is_an_empty_dataset(tmp_path):
    schema = pa.schema([("scene_id", pa.string()), ("kind", pa.string()), ("uri", pa.string())])
    pq.write_table(schema.empty_table(), tmp_path / "m.parquet")
    assert build(tmp_path / "m.parquet", tmp_path / "out").tally.total == 0
    assert "| done | 0 |" in (tmp_path / "out" / "README.md").read_text()


def test_another_configuration_or_manifest_refuses_and_says_what_differs(mixed, tmp_path):
    manifest, out = mixed
    before = digests(out)
    with pytest.raises(BuildError, match=r"config\.run\.seed was 0 and is now 5.*another OUT"):
        build(manifest, out, seed=5)
    other = write_manifest(tmp_path / "m.parquet", [*MIXED, "fine"])
    words = (
        "its manifest has 12 scenes and this one 13, with 12 in both. Go on with the manifest .* or give another OUT$"
    )
    with pytest.raises(BuildError, match=words) as told:
        build(other, out)
    assert "sha256" not in str(told.value)
    moved = write_manifest(tmp_path / "m.parquet", MIXED, root="/elsewhere")
    with pytest.raises(BuildError, match=r"same scenes with other values of uri, first in scene_000\. "):
        build(moved, out)
    assert digests(out) == before


def test_more_workers_than_this_machine_has_are_refused_before_ray_starts(mixed, tmp_path):
    display = Silent()
    asked = replace(request(mixed[0], tmp_path / "out"), executor="ray", workers=1_000_000)
    words = rf"1000000 workers need 1000000 CPUs and this machine has \d+: give --workers {os.cpu_count()}$"
    with pytest.raises(BuildError, match=words):
        run_build(asked, display)
    assert display.notes == []
    assert not (tmp_path / "out").exists()


def test_a_folder_of_somebody_else_is_left_alone(mixed, tmp_path):
    (tmp_path / "thesis.tex").write_text("important")
    with pytest.raises(BuildError, match=r"holds thesis\.tex but no build"):
        build(mixed[0], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_one_writer_at_a_time(mixed, tmp_path):
    manifest, _ = mixed
    with (
        create_writer_lock(tmp_path / "out" / ".work" / "lock"),
        pytest.raises(BuildError, match="being written by process"),
    ):
        build(manifest, tmp_path / "out")
    build(manifest, tmp_path / "out")


@pytest.mark.parametrize("times", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_kill_minus_nine_at_random_moments_gives_the_same_bytes(tmp_path, times):
    names = [*MIXED, *["slow_0.3"] * (4 * times)]
    manifest = write_manifest(tmp_path / "m.parquet", names)
    build(manifest, tmp_path / "whole", deadline_s=20.0)
    rng = random.Random(11)
    kills = 0
    for _ in range(times):
        process = start(manifest, tmp_path / "out", deadline_s=20.0)
        wait_until(lambda: any((tmp_path / "out" / ".work").glob("*.journal")))
        time.sleep(rng.uniform(0.0, 1.0))
        kills += process.poll() is None
        kill(process)
    assert kills >= max(times - 1, 1), "a build that is done before it is killed proves nothing"
    code, errors = finish(start(manifest, tmp_path / "out", deadline_s=20.0))
    assert code == 0, errors
    assert digests(tmp_path / "out") == digests(tmp_path / "whole")


@pytest.mark.parametrize(("name", "code"), [pytest.param("SIGINT", 130, marks=pytest.mark.slow), ("SIGTERM", 143)])
def test_a_signal_stops_within_three_seconds_and_the_same_command_goes_on(tmp_path, name, code):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine", "slow_2", "fine"])
    process = start(manifest, tmp_path / "out")
    wait_until(lambda: any((tmp_path / "out" / ".work").glob("*.journal")))
    process.send_signal(getattr(signal, name))
    asked = time.monotonic()
    assert finish(process)[0] == code
    assert time.monotonic() - asked < 3.0 * crowd()
    assert read_build_state(tmp_path / "out").remaining == 2
    build(manifest, tmp_path / "out")
    build(manifest, tmp_path / "whole")
    assert digests(tmp_path / "out") == digests(tmp_path / "whole")


def test_retry_computes_the_failed_scene_alone_and_gives_the_bytes_of_a_lucky_build(tmp_path, monkeypatch):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine", "segfault_twice", "fine", "empty", "fine", "fine"])
    for name, cuts in (("lucky", b"xx"), ("out", b"")):
        marks = tmp_path / f"marks_{name}"
        marks.mkdir()
        (marks / "scene_001.cut").write_bytes(cuts)
        monkeypatch.setenv("TINY_LINE_MARKS", str(marks))
        build(manifest, tmp_path / name, attempts=1)
    out, whole = tmp_path / "out", digests(tmp_path / "lucky")
    failed = [ending.scene_id for ending in read_build_state(out).list_lost() if ending.status == "failed"]
    assert failed == ["scene_001"]
    assert digests(out) != whole

    assert reopen_scenes(out, failed) == 1
    found = read_build_state(out)
    assert (found.remaining, found.committed, found.done) == (1, 1, 4)
    for mark in marks.iterdir():
        if not mark.name.startswith("scene_001"):
            mark.unlink()
    before = (out / "scenes" / "shard-00001.parquet").stat().st_mtime_ns
    build(manifest, out, attempts=1)
    assert {path.name.split(".")[0] for path in marks.iterdir()} == {"scene_001"}
    assert (out / "scenes" / "shard-00001.parquet").stat().st_mtime_ns == before
    assert digests(out) == whole


def test_a_survey_of_nothing_is_a_clear_error(tmp_path):
    with pytest.raises(BuildError, match="holds no build"):
        read_build_state(tmp_path)
