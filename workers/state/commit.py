"""Commit of one shard: staged beside the dataset, then moved into place file by file, the scenes file last.

A shard is staged in `.work/shard-00000.staging/`; the file `.work/shard-00000.ready` decides. A kill before it leaves
the dataset as it was; a kill after it is repaired by `publish_ready` on the next start. On the disk staged files are
renamed; in an object store the store copies them, and they are removed at the end.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import Any, BinaryIO

from schemas.codec import decode
from schemas.manifest import ImageRow
from schemas.scene import ExportedScene
from schemas.tables import STORED_TABLES
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import (
    StoragePath,
    abort_uploads,
    atomic_file,
    list_names,
    move,
    open_stream,
    read_whole,
    remove,
    remove_folder,
    write_atomic,
)
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.licences import scene_license
from tableverse_factory.dataset.model_costs import COST_COLUMNS, make_cost_columns
from tableverse_factory.dataset.shards import (
    FOLDERS,
    SPARSE,
    TarShard,
    is_committed,
    shard_name,
    shard_path,
    shard_stem,
    tar_sort_key,
)
from tableverse_factory.dataset.trajectory_files import add_digests

STAGING, READY = ".staging", ".ready"
_WITHOUT = "without "  # in the ready file before a folder for which the shard has no rows: an older file goes

SceneRows = dict[str, list[dict[str, Any]]]  # the rows of one scene in each table


class CommittedShard:
    """A shard as committed, for the scenes that stay as they are when others of it are recomputed."""

    def __init__(self, out: StoragePath, number: int) -> None:
        """Read the shard's tables."""
        self._tar_path = shard_path(out, "mjcf", number)
        self._tar: BinaryIO | None = None
        self._rows: dict[str, SceneRows] = {}
        for table in STORED_TABLES:
            try:
                rows = read_shard(out, table, number).to_pylist()
            except FileNotFoundError as error:
                if table not in SPARSE:
                    raise BuildError(f"{shard_path(out, table, number)} is missing") from error
                rows = []
            by_scene = self._rows.setdefault(table, {})
            for row in rows:
                by_scene.setdefault(row["scene_id"], []).append(row)

    def merge_earlier_stages(self, scene_id: str, rows: SceneRows, post_export: Mapping[str, object]) -> SceneRows:
        """Add to the rows of a scene what the stages before its post-export stages took and cost."""
        (old,), timings = self._rows["scenes"][scene_id], self._rows["timings"].get(scene_id, [])
        (scene,) = rows["scenes"]
        earlier = [row for row in timings if row["stage"] not in post_export]
        attempts = max(scene["attempts"], old["attempts"] or 0)
        costs = {name: old[name] for name in COST_COLUMNS}
        return {
            **rows,
            "scenes": [{**scene, "attempts": attempts, **costs}],
            "timings": [*earlier, *rows["timings"]],
        }

    def copy(self, scene_id: str, tar: TarShard) -> SceneRows:
        """Copy a scene's files to another tar; return its rows with their new offsets."""
        tables = {table: rows.get(scene_id, []) for table, rows in self._rows.items()}
        (scene,) = tables["scenes"]
        if scene["tar_offset"] is not None:
            self._tar = self._tar or open_stream(self._tar_path)
            offset, size = tar.copy(self._tar, scene["tar_offset"], scene["tar_size"])
            tables = {**tables, "scenes": [{**scene, "tar_offset": offset, "tar_size": size}]}
        return tables

    def close(self) -> None:
        """Close the tar."""
        if self._tar is not None:
            self._tar.close()


def commit_shard(
    out: StoragePath,
    work: StoragePath,
    number: int,
    rows: Sequence[ImageRow],
    read_result: Callable[[str], SceneResult | None],
    guard: Callable[[], None],
    post_export: Mapping[str, Sequence[str]],
) -> int:
    """Write and publish a shard; returns the bytes of its scenes and tables.

    `work` is on the same file system or in the same store, `rows` are in the plan's order. `read_result` returns a
    scene's new result, or None if what the committed shard has of it stays. `guard` is called before each step that
    others see and raises if this process is no longer the writer. `post_export` has the tables that each post-export
    stage writes.
    """
    staging = _staging(work, number)
    remove_folder(staging)
    done = _write_tar(out, staging, number, rows, read_result, post_export)
    size, empty = _write_tables(staging, rows, done)
    guard()
    write_atomic(_ready(work, number), "".join(["ready\n", *(f"{_WITHOUT}{table}\n" for table in empty)]).encode())
    _publish(out, work, number, guard)
    return size


def publish_ready(out: StoragePath, work: StoragePath, guard: Callable[[], None] = lambda: None) -> None:
    """Finish commits that a kill interrupted after their decision, and discard the others."""
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
    read_result: Callable[[str], SceneResult | None],
    post_export: Mapping[str, Sequence[str]],
) -> dict[str, SceneRows]:
    committed: CommittedShard | None = None
    done: dict[str, SceneRows] = {}
    with ExitStack() as stack:

        def load_committed() -> CommittedShard:
            nonlocal committed
            committed = committed or stack.enter_context(closing(CommittedShard(out, number)))
            return committed

        tar = TarShard(stack.enter_context(atomic_file(_staged(staging, "mjcf"))))
        for row in sorted(rows, key=lambda row: tar_sort_key(row.scene_id)):
            result = read_result(row.scene_id)
            if result is None:
                done[row.scene_id] = load_committed().copy(row.scene_id, tar)
                continue
            scene = _add_scene(tar, row, result, number, post_export)
            ran = {timing.stage for timing in result.timings}
            if ran and ran <= post_export.keys() and is_committed(out, number):
                scene = load_committed().merge_earlier_stages(row.scene_id, scene, post_export)
            done[row.scene_id] = scene
        tar.close()
    return done


def _add_scene(
    tar: TarShard, row: ImageRow, result: SceneResult, number: int, post_export: Mapping[str, Sequence[str]]
) -> SceneRows:
    """Append a scene's files to the tar and make its rows."""
    rows: SceneRows = {table: [] for table in STORED_TABLES}
    scene: dict[str, Any] = {}
    offset: int | None = None
    size: int | None = None
    if result.exported is not None:
        exported: ExportedScene = decode(result.exported)
        scene = exported.scene_row
        rows["objects"], rows["tasks"] = list(exported.object_rows), list(exported.task_rows)
        rows["trajectories"] = add_digests(exported.trajectory_rows, exported.files)
        offset, size = tar.add(exported)
    if "trajectories" in post_export.get(result.stage, ()) and result.status == "done":
        successes = sum(bool(trajectory["success"]) for trajectory in rows["trajectories"])
        scene = {**scene, "n_trajectories": len(rows["trajectories"]), "n_successes": successes}
    scene = {
        **scene,
        **{name: getattr(row, name) or None for name in ("name", "url", "source", "licence", "content_sha256")},
        **{name: getattr(result, name) or None for name in ("reason", "error_kind", "detail")},
        **{name: getattr(result, name) for name in ("status", "stage", "attempts")},
        "scene_id": row.scene_id,
        "kind": row.kind.value,
        "uri": row.uri,
        "licence_verdict": scene_license({"licence": row.licence, "mesh_licences": scene.get("mesh_licences")}).value,
        **make_cost_columns(result.costs),
        "shard": number,
        "tar_offset": offset,
        "tar_size": size,
    }
    rows["scenes"] = [scene]
    rows["timings"] = [
        {"scene_id": row.scene_id, "stage": t.stage, "cpu_s": t.cpu_s, "wall_s": t.wall_s} for t in result.timings
    ]
    return rows


def _write_tables(
    staging: StoragePath, rows: Sequence[ImageRow], done: Mapping[str, SceneRows]
) -> tuple[int, list[str]]:
    """Write the tables; return the bytes of scenes and tables, and the tables without rows, which have no file."""
    size = sum(scene["tar_size"] or 0 for entry in rows for scene in done[entry.scene_id]["scenes"])
    empty: list[str] = []
    for table, schema in STORED_TABLES.items():
        in_order = [row for entry in rows for row in done[entry.scene_id][table]]
        if table in SPARSE and not in_order:
            empty.append(table)
            continue
        data = encode_parquet(build_table(in_order, schema))
        write_atomic(_staged(staging, table), data)
        size += len(data)
    return size, empty


def _publish(out: StoragePath, work: StoragePath, number: int, guard: Callable[[], None]) -> None:
    """Move the staged files into place; safe to repeat after a kill at any point."""
    staging = _staging(work, number)
    staged = set(list_names(staging))
    if _staged(staging, "scenes").name in staged:  # otherwise all of them have been moved already
        guard()
        remove(shard_path(out, "scenes", number))
        _remove_emptied(out, read_whole(_ready(work, number)).decode(), number)
    for folder in (*SPARSE, *FOLDERS):
        if _staged(staging, folder).name in staged:
            guard()
            move(_staged(staging, folder), shard_path(out, folder, number))
    remove(_ready(work, number))
    remove_folder(staging)


def _remove_emptied(out: StoragePath, decision: str, number: int) -> None:
    """Remove the shard's older files in folders for which it has no rows any more."""
    for folder in (line.removeprefix(_WITHOUT) for line in decision.splitlines() if line.startswith(_WITHOUT)):
        if folder in SPARSE and shard_name(folder, number) in list_names(out / folder):
            remove(shard_path(out, folder, number))


def _staging(work: StoragePath, number: int) -> StoragePath:
    return work / f"{shard_stem(number)}{STAGING}"


def _ready(work: StoragePath, number: int) -> StoragePath:
    return work / f"{shard_stem(number)}{READY}"


def _staged(folder: StoragePath, table: str) -> StoragePath:
    return folder / f"{table}.{(FOLDERS | SPARSE)[table]}"
