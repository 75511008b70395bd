"""Merged tables hold the rows of the shards, and are believed only as long as they do."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.tables import OBJECTS, SCENES, TABLES, TASKS, TRAJECTORIES
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import ROW_GROUP, build_table, encode_parquet
from tableverse_factory.dataset.consolidated_tables import (
    MANY_SHARDS,
    merged_path,
    remove_merged_tables,
    write_merged_tables,
)
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.shards import shard_path
from tests.helpers.builds import build, digests, scenes, write_manifest
from tests.helpers.small_dataset import write_small_dataset
from workers.plan.invalidate import reopen_scenes

pytestmark = pytest.mark.heavy

N_SHARDS = MANY_SHARDS + 3


def _write_shards(out: Path, objects: int) -> Path:
    """Two scenes a shard; `objects` of each."""
    for shard in range(N_SHARDS):
        ids = [f"scene-{2 * shard + i:03d}" for i in range(2)]
        rows = [{"scene_id": i, "shard": shard, "status": "done", "quality_score": shard % 7} for i in ids]
        things = [{"scene_id": i, "object_id": f"obj_{k:03d}", "mass_kg": 0.1 * k} for i in ids for k in range(objects)]
        motions = [{"scene_id": i, "task_id": "task_000", "success": True} for i in ids]
        tables = {"scenes": (rows, SCENES), "objects": (things, OBJECTS), "tasks": ([], TASKS)}
        if shard % 2:  # few shards have trajectories
            tables["trajectories"] = (motions, TRAJECTORIES)
        for name, (content, schema) in tables.items():
            write_atomic(shard_path(out, name, shard), encode_parquet(build_table(content, schema)))
    (out / "run.json").write_text("{}")
    return out


@pytest.fixture
def out(tmp_path):
    return _write_shards(tmp_path / "out", 3)


def test_the_rows_are_those_of_the_shards_in_their_order(out):
    before = {name: open_dataset(out).table(name).to_table() for name in TABLES}
    write_merged_tables(out, N_SHARDS)
    for name, rows in before.items():
        opened = open_dataset(out).table(name)
        assert [Path(path).parts[-2] for path in opened.files] == ["merged"]
        assert opened.to_table().equals(rows)
    assert open_dataset(out).scene_row("scene-005")["shard"] == 2


def test_row_groups_have_one_size_whatever_the_shards_have(tmp_path):
    out = _write_shards(tmp_path / "out", ROW_GROUP // 24)
    write_merged_tables(out, N_SHARDS)
    metadata = pq.read_metadata(merged_path(out, "objects"))
    groups = [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]
    assert groups[:-1] == [ROW_GROUP] * (len(groups) - 1)
    assert len(groups) > 1
    assert sum(groups) == N_SHARDS * 2 * (ROW_GROUP // 24)


def test_a_shard_that_changed_is_read_instead(out):
    write_merged_tables(out, N_SHARDS)
    write_atomic(shard_path(out, "objects", 0), encode_parquet(OBJECTS.empty_table()))
    opened = open_dataset(out).objects
    assert len(opened.files) == N_SHARDS
    assert opened.count_rows() == 6 * (N_SHARDS - 1)
    shard_path(out, "scenes", 5).unlink()  # as while it is being written again
    assert open_dataset(out).scenes.count_rows() == 2 * (N_SHARDS - 1)


@pytest.mark.parametrize("damage", [b"", b"PAR1", b"no parquet at all"])
def test_a_damaged_merged_table_is_passed_over_and_written_again(out, damage):
    write_merged_tables(out, N_SHARDS)
    whole = merged_path(out, "scenes").read_bytes()
    merged_path(out, "scenes").write_bytes(damage)
    assert open_dataset(out).scenes.count_rows() == 2 * N_SHARDS
    write_merged_tables(out, N_SHARDS)
    assert merged_path(out, "scenes").read_bytes() == whole


def test_few_shards_and_missing_ones_are_not_merged(out, tmp_path):
    write_merged_tables(write_small_dataset(tmp_path / "small"), 3)
    assert not (tmp_path / "small" / "merged").exists()
    shard_path(out, "tasks", 4).unlink()
    with pytest.raises(BuildError, match=r"tasks/shard-00004\.parquet is missing"):
        write_merged_tables(out, N_SHARDS)


def test_a_build_writes_them_removes_them_before_it_works_and_gives_the_same_bytes(tmp_path, monkeypatch):
    names = ["fine", "segfault_once", *["fine"] * (MANY_SHARDS - 1)]
    manifest = write_manifest(tmp_path / "m.parquet", names)
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("TINY_LINE_MARKS", str(marks))
    out, run = tmp_path / "out", {"shard_size": 1, "attempts": 1}
    build(manifest, out, **run)
    build(manifest, tmp_path / "lucky", **run)
    assert open_dataset(tmp_path / "lucky").scenes.files == [str(merged_path(tmp_path / "lucky", "scenes"))]
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    build(manifest, out, **run)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()} == before

    assert reopen_scenes(out, ["scene_001"]) == 1
    build(manifest, out, **run)
    assert digests(out) == digests(tmp_path / "lucky")
    assert open_dataset(out).scenes.to_table().to_pylist() == scenes(out)
    remove_merged_tables(out)
    assert open_dataset(out).scenes.to_table().to_pylist() == scenes(out)


def test_memory_order_of_columns_is_the_schema_s(out):
    write_merged_tables(out, N_SHARDS)
    assert all(pq.read_schema(merged_path(out, name)).equals(pa.schema(TABLES[name])) for name in TABLES)
