"""Writing one shard: staged beside the dataset, then moved into place file by file, the scenes file last.

A shard is staged in `.work/shard-00000.staging/`; renaming that folder to `.ready` decides. A kill before it leaves the
dataset as it was; a kill after it is repaired by `publish_ready` on the next start.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from schemas.arrow import OBJECTS, SCENES, TASKS, TIMINGS
from schemas.codec import decode
from schemas.manifest import ImageRow
from schemas.scene import ExportedScene
from schemas.work import SceneResult
from tableverse_factory.errors import BuildError
from tableverse_factory.licences import verdict_of
from tableverse_factory.shards import FOLDERS, TarShard, parquet_bytes, read_shard, rows_to_table, shard_path, tar_order
from tableverse_factory.storage import atomic_file, cannot_write, move_into_place, sync_folder, write_atomic

STAGING, READY = ".staging", ".ready"
_SCHEMAS: dict[str, pa.Schema] = {"scenes": SCENES, "objects": OBJECTS, "tasks": TASKS, "timings": TIMINGS}

Rows = list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class SceneRows:
    """The rows of one scene in each table, complete."""

    tables: Mapping[str, Rows]


class CommittedShard:
    """A shard as it stands in OUT, for the scenes that stay as they are when others of the shard are computed again."""

    def __init__(self, out: Path, number: int) -> None:
        """Reads the shard's tables.

        Raises:
            BuildError: if one is missing or unreadable.
        """
        self._tar = shard_path(out, "mjcf", number)
        self._rows: dict[str, dict[str, Rows]] = {}
        for table, schema in _SCHEMAS.items():
            path = shard_path(out, table, number)
            try:
                rows = read_shard(path, schema).to_pylist()
            except FileNotFoundError as error:
                raise BuildError(f"{path} is missing") from error
            by_scene: dict[str, Rows] = {}
            for row in rows:
                by_scene.setdefault(row["scene_id"], []).append(row)
            self._rows[table] = by_scene

    def copy(self, scene_id: str, tar: TarShard) -> SceneRows:
        """Copies a scene's files to another tar; returns its rows with their new offsets."""
        tables = {table: rows.get(scene_id, []) for table, rows in self._rows.items()}
        (scene,) = tables["scenes"]
        if scene["tar_offset"] is not None:
            with self._tar.open("rb") as source:
                offset, size = tar.copy(source, scene["tar_offset"], scene["tar_size"])
            tables = {**tables, "scenes": [{**scene, "tar_offset": offset, "tar_size": size}]}
        return SceneRows(tables)


def commit_shard(
    out: Path, work: Path, number: int, rows: Sequence[ImageRow], result_of: Callable[[str], SceneResult | None]
) -> None:
    """Writes and publishes a shard.

    Args:
        out: The dataset.
        work: Folder of the work in progress, on the same file system.
        number: Which shard.
        rows: Its manifest rows, in the plan's order.
        result_of: A scene's new result, or None where the committed shard's answer stays.

    Raises:
        BuildError: if the disk is full or refuses; the dataset is as before then.
    """
    staging = work / f"shard-{number:05d}{STAGING}"
    shutil.rmtree(staging, ignore_errors=True)
    done = _write_tar(out, staging, number, rows, result_of)
    for table, schema in _SCHEMAS.items():
        in_order = [row for entry in rows for row in done[entry.scene_id].tables[table]]
        write_atomic(_staged(staging, table), parquet_bytes(rows_to_table(in_order, schema)))
    ready = staging.with_suffix(READY)
    move_into_place(staging, ready)
    _publish(out, ready, number)


def publish_ready(out: Path, work: Path) -> None:
    """Finishes commits that a kill interrupted, and forgets those that were not decided.

    Raises:
        BuildError: if the disk refuses.
    """
    for staging in sorted(work.glob(f"shard-*{STAGING}")):
        shutil.rmtree(staging)
    for ready in sorted(work.glob(f"shard-*{READY}")):
        _publish(out, ready, int(ready.stem.removeprefix("shard-")))


def _write_tar(
    out: Path, staging: Path, number: int, rows: Sequence[ImageRow], result_of: Callable[[str], SceneResult | None]
) -> dict[str, SceneRows]:
    committed: CommittedShard | None = None
    done: dict[str, SceneRows] = {}
    with atomic_file(_staged(staging, "mjcf")) as file:
        tar = TarShard(file)
        for row in sorted(rows, key=lambda row: tar_order(row.scene_id)):
            result = result_of(row.scene_id)
            if result is None:
                committed = committed or CommittedShard(out, number)
                done[row.scene_id] = committed.copy(row.scene_id, tar)
            else:
                done[row.scene_id] = _add(tar, row, result, number)
        tar.close()
    return done


def _add(tar: TarShard, row: ImageRow, result: SceneResult, number: int) -> SceneRows:
    scene: dict[str, Any] = {}
    objects: Rows = []
    tasks: Rows = []
    offset: int | None = None
    size: int | None = None
    if result.exported is not None:
        exported: ExportedScene = decode(result.exported)
        scene, objects, tasks = exported.scene_row, list(exported.object_rows), list(exported.task_rows)
        offset, size = tar.add(exported)
    scene = {
        **scene,
        "scene_id": row.scene_id,
        "kind": row.kind.value,
        "name": row.name or None,
        "source": row.source or None,
        "uri": row.uri,
        "licence": row.licence or None,
        "licence_verdict": verdict_of(row.licence).value,
        "content_sha256": row.content_sha256 or None,
        "status": result.status,
        "stage": result.stage,
        "reason": result.reason or None,
        "error_kind": result.error_kind or None,
        "detail": result.detail or None,
        "attempts": result.attempts,
        "shard": number,
        "tar_offset": offset,
        "tar_size": size,
    }
    timings = [
        {"scene_id": row.scene_id, "stage": t.stage, "cpu_s": t.cpu_s, "wall_s": t.wall_s} for t in result.timings
    ]
    return SceneRows({"scenes": [scene], "objects": objects, "tasks": tasks, "timings": timings})


def _publish(out: Path, ready: Path, number: int) -> None:
    """Moves the staged files over; safe to repeat after a kill at any point."""
    scenes = _staged(ready, "scenes")
    try:
        if scenes.exists():  # otherwise all of them have been moved already
            shard_path(out, "scenes", number).unlink(missing_ok=True)
        for folder in FOLDERS:
            if _staged(ready, folder).exists():
                move_into_place(_staged(ready, folder), shard_path(out, folder, number))
        ready.rmdir()
        sync_folder(ready.parent)
    except OSError as error:
        raise cannot_write(ready, error) from error


def _staged(folder: Path, table: str) -> Path:
    return folder / f"{table}.{FOLDERS[table]}"
