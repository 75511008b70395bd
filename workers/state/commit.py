"""Writing one shard: staged beside the dataset, then put into place file by file, the scenes file last.

A shard is staged in `.work/shard-00000.staging/`; the file `.work/shard-00000.ready` decides. A kill before it leaves
the dataset as it was; a kill after it is repaired by `publish_ready` on the next start. The same on the disk, where
staged files are renamed, and in an object store, where they are copied by the store and removed at the end.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, BinaryIO

import pyarrow as pa

from schemas.arrow import OBJECTS, SCENES, TASKS, TIMINGS, TRAJECTORIES
from schemas.codec import decode
from schemas.manifest import ImageRow
from schemas.scene import ExportedScene
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import (
    StoragePath,
    abort_uploads,
    atomic_file,
    list_names,
    move,
    open_to_read,
    read_whole,
    remove,
    remove_folder,
    write_atomic,
)
from tableverse_factory.dataset.licences import scene_license
from tableverse_factory.dataset.model_costs import COST_COLUMNS, cost_columns
from tableverse_factory.dataset.shards import (
    FOLDERS,
    SPARSE,
    TarShard,
    is_committed,
    parquet_bytes,
    read_shard,
    rows_to_table,
    shard_name,
    shard_path,
    tar_order,
)
from tableverse_factory.dataset.trajectory_files import with_digests

STAGING, READY = ".staging", ".ready"
TRAJECTORIES_STAGE = "trajectories"
_WITHOUT = "without "
"""Before the name of a folder, in the file that decides: the shard has no rows for it, so an older file goes."""
_SCHEMAS: dict[str, pa.Schema] = {
    "scenes": SCENES,
    "objects": OBJECTS,
    "tasks": TASKS,
    "timings": TIMINGS,
    "trajectories": TRAJECTORIES,
}

Rows = list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class SceneRows:
    """The rows of one scene in each table, complete."""

    tables: Mapping[str, Rows]


class CommittedShard:
    """A shard as it stands in OUT, for the scenes that stay as they are when others of the shard are computed again."""

    def __init__(self, out: StoragePath, number: int) -> None:
        """Reads the shard's tables.

        Raises:
            BuildError: if one is missing or unreadable.
        """
        self._tar_path = shard_path(out, "mjcf", number)
        self._tar: BinaryIO | None = None
        self._rows: dict[str, dict[str, Rows]] = {}
        for table, schema in _SCHEMAS.items():
            path = shard_path(out, table, number)
            try:
                rows = read_shard(path, schema).to_pylist()
            except FileNotFoundError as error:
                if table not in SPARSE:
                    raise BuildError(f"{path} is missing") from error
                rows = []
            by_scene: dict[str, Rows] = {}
            for row in rows:
                by_scene.setdefault(row["scene_id"], []).append(row)
            self._rows[table] = by_scene

    def before(self, scene_id: str, rows: SceneRows) -> SceneRows:
        """The rows of a scene to which trajectories were added, with what the stages before them took."""
        (old,), timings = self._rows["scenes"][scene_id], self._rows["timings"].get(scene_id, [])
        (scene,) = rows.tables["scenes"]
        kept = [row for row in timings if row["stage"] != TRAJECTORIES_STAGE]
        attempts = max(scene["attempts"], old["attempts"] or 0)
        costs = {name: old[name] for name in COST_COLUMNS}
        added = {"scenes": [{**scene, "attempts": attempts, **costs}], "timings": [*kept, *rows.tables["timings"]]}
        return SceneRows({**rows.tables, **added})

    def copy(self, scene_id: str, tar: TarShard) -> SceneRows:
        """Copies a scene's files to another tar; returns its rows with their new offsets."""
        tables = {table: rows.get(scene_id, []) for table, rows in self._rows.items()}
        (scene,) = tables["scenes"]
        if scene["tar_offset"] is not None:
            self._tar = self._tar or open_to_read(self._tar_path)
            offset, size = tar.copy(self._tar, scene["tar_offset"], scene["tar_size"])
            tables = {**tables, "scenes": [{**scene, "tar_offset": offset, "tar_size": size}]}
        return SceneRows(tables)

    def close(self) -> None:
        """Closes the tar."""
        if self._tar is not None:
            self._tar.close()


def commit_shard(
    out: StoragePath,
    work: StoragePath,
    number: int,
    rows: Sequence[ImageRow],
    result_of: Callable[[str], SceneResult | None],
    guard: Callable[[], None] = lambda: None,
) -> int:
    """Writes and publishes a shard.

    Args:
        out: The dataset.
        work: Folder of the work in progress, on the same file system or in the same store.
        number: Which shard.
        rows: Its manifest rows, in the plan's order.
        result_of: A scene's new result, or None where the committed shard's answer stays.
        guard: Called before each step that others see; raises where this process is no longer the writer.

    Returns:
        Bytes of the scenes and the tables.

    Raises:
        BuildError: if the disk is full, or it or the store refuses; the dataset is as before then.
    """
    staging = _staging(work, number)
    remove_folder(staging)
    done = _write_tar(out, staging, number, rows, result_of)
    size, empty = _write_tables(staging, rows, done)
    guard()
    write_atomic(_ready(work, number), "".join(["ready\n", *(f"{_WITHOUT}{table}\n" for table in empty)]).encode())
    _publish(out, work, number, guard)
    return size


def _write_tables(
    staging: StoragePath, rows: Sequence[ImageRow], done: Mapping[str, SceneRows]
) -> tuple[int, list[str]]:
    """Bytes of the tables and of the scenes in them, and the tables that have no rows and no file."""
    size = sum(scene["tar_size"] or 0 for entry in rows for scene in done[entry.scene_id].tables["scenes"])
    empty: list[str] = []
    for table, schema in _SCHEMAS.items():
        in_order = [row for entry in rows for row in done[entry.scene_id].tables[table]]
        if table in SPARSE and not in_order:
            empty.append(table)
            continue
        data = parquet_bytes(rows_to_table(in_order, schema))
        write_atomic(_staged(staging, table), data)
        size += len(data)
    return size, empty


def publish_ready(out: StoragePath, work: StoragePath, guard: Callable[[], None] = lambda: None) -> None:
    """Finishes commits that a kill interrupted, and forgets those that were not decided.

    Args:
        out: The dataset.
        work: Folder of the work in progress.
        guard: See `commit_shard`.

    Raises:
        BuildError: if the disk or the store refuses.
    """
    names = list_names(work)
    abort_uploads(out)
    for name in names:
        if name.endswith(READY):
            _publish(out, work, int(name.removeprefix("shard-").removesuffix(READY)), guard)
    for name in names:
        if name.endswith(STAGING):
            remove_folder(work / name)


def _write_tar(
    out: StoragePath,
    staging: StoragePath,
    number: int,
    rows: Sequence[ImageRow],
    result_of: Callable[[str], SceneResult | None],
) -> dict[str, SceneRows]:
    committed: CommittedShard | None = None
    done: dict[str, SceneRows] = {}
    with ExitStack() as stack:
        tar = TarShard(stack.enter_context(atomic_file(_staged(staging, "mjcf"))))
        for row in sorted(rows, key=lambda row: tar_order(row.scene_id)):
            result = result_of(row.scene_id)
            if result is None:
                committed = committed or stack.enter_context(closing(CommittedShard(out, number)))
                done[row.scene_id] = committed.copy(row.scene_id, tar)
            else:
                done[row.scene_id] = _add(tar, row, result, number)
                if {timing.stage for timing in result.timings} == {TRAJECTORIES_STAGE} and is_committed(out, number):
                    committed = committed or stack.enter_context(closing(CommittedShard(out, number)))
                    done[row.scene_id] = committed.before(row.scene_id, done[row.scene_id])
        tar.close()
    return done


def _add(tar: TarShard, row: ImageRow, result: SceneResult, number: int) -> SceneRows:
    scene: dict[str, Any] = {}
    objects: Rows = []
    tasks: Rows = []
    motions: Rows = []
    offset: int | None = None
    size: int | None = None
    if result.exported is not None:
        exported: ExportedScene = decode(result.exported)
        scene, objects, tasks = exported.scene_row, list(exported.object_rows), list(exported.task_rows)
        motions = with_digests(exported.trajectory_rows, exported.files)
        offset, size = tar.add(exported)
    if result.stage == TRAJECTORIES_STAGE and result.status == "done":
        scene = {**scene, "n_trajectories": len(motions), "n_successes": sum(bool(m["success"]) for m in motions)}
    scene = {
        **scene,
        "scene_id": row.scene_id,
        "kind": row.kind.value,
        "name": row.name or None,
        "url": row.url or None,
        "source": row.source or None,
        "uri": row.uri,
        "licence": row.licence or None,
        "licence_verdict": scene_license({"licence": row.licence, "mesh_licences": scene.get("mesh_licences")}).value,
        "content_sha256": row.content_sha256 or None,
        "status": result.status,
        "stage": result.stage,
        "reason": result.reason or None,
        "error_kind": result.error_kind or None,
        "detail": result.detail or None,
        "attempts": result.attempts,
        **cost_columns(result.costs),
        "shard": number,
        "tar_offset": offset,
        "tar_size": size,
    }
    timings = [
        {"scene_id": row.scene_id, "stage": t.stage, "cpu_s": t.cpu_s, "wall_s": t.wall_s} for t in result.timings
    ]
    tables = {"scenes": [scene], "objects": objects, "tasks": tasks, "timings": timings, "trajectories": motions}
    return SceneRows(tables)


def _publish(out: StoragePath, work: StoragePath, number: int, guard: Callable[[], None]) -> None:
    """Puts the staged files into place; safe to repeat after a kill at any point."""
    staging = _staging(work, number)
    there = set(list_names(staging))
    if _staged(staging, "scenes").name in there:  # otherwise all of them have been moved already
        guard()
        remove(shard_path(out, "scenes", number))
        _remove_emptied(out, read_whole(_ready(work, number)).decode(), number)
    for folder in (*SPARSE, *FOLDERS):
        if _staged(staging, folder).name in there:
            guard()
            move(_staged(staging, folder), shard_path(out, folder, number))
    remove(_ready(work, number))
    remove_folder(staging)


def _remove_emptied(out: StoragePath, decided: str, number: int) -> None:
    """Removes what an older version of the shard had in folders for which this one has no rows."""
    for folder in (line.removeprefix(_WITHOUT) for line in decided.splitlines() if line.startswith(_WITHOUT)):
        if folder in SPARSE and shard_name(folder, number) in list_names(out / folder):
            remove(shard_path(out, folder, number))


def _staging(work: StoragePath, number: int) -> StoragePath:
    return work / f"shard-{number:05d}{STAGING}"


def _ready(work: StoragePath, number: int) -> StoragePath:
    return work / f"shard-{number:05d}{READY}"


def _staged(folder: StoragePath, table: str) -> StoragePath:
    return folder / f"{table}.{(FOLDERS | SPARSE)[table]}"
