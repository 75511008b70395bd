"""Commit of one shard in two phases: a worker stages its files beside the dataset, and the driver publishes them.

A worker writes the tar and the tables into `.work/shard-00000.TOKEN.staging/`, a folder of its own: one that was given
up for lost can still run beside its successor. The driver's file `.work/shard-00000.ready` names the folder and
decides; then the files are moved into place one by one, the scenes file last. A kill before the decision leaves the
dataset as it was; a kill after it is repaired by `publish_ready` on the next start. On the disk staged files are
renamed; in an object store the store copies them, and they are removed at the end.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import cache
from typing import BinaryIO

from schemas.tables import STORED_TABLES
from schemas.work import CommitCall, SceneResult, StagedShard
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import FrameError
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
from tableverse_factory.dataset.journals import WORK, journal_path, read_results
from tableverse_factory.dataset.model_costs import COST_COLUMNS
from tableverse_factory.dataset.parts import SceneRows, read_part_files, read_part_rows
from tableverse_factory.dataset.scene_rows import complete_rows
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

STAGING, READY = ".staging", ".ready"
_WITHOUT = "without "  # in the ready file before a folder for which the shard has no rows: an older file goes
_STAGED = re.compile(rf"shard-\d{{5,9}}\.[0-9a-f]+{re.escape(STAGING)}")
_DECIDED = re.compile(rf"shard-(\d{{5,9}}){re.escape(READY)}")
_DECISION = re.compile(rf"ready\n[0-9a-f]+\n({_WITHOUT}\w+\n)*")  # a dataset from elsewhere may hold any other


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

    def merge_earlier_stages(self, scene_id: str, rows: SceneRows, post_export: Collection[str]) -> SceneRows:
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


def stage_shard(out: StoragePath, call: CommitCall) -> StagedShard:
    """Write the files of a shard whose scenes all have results, beside the dataset (phase one).

    Scenes without a new result stay as the committed shard has them. Memory holds one scene at a time, and all rows.
    """
    results = read_results(journal_path(out, call.shard))
    rows: dict[str, SceneRows] = {}
    damaged: list[str] = []
    with ExitStack() as stack:

        @cache
        def load_committed() -> CommittedShard:
            return stack.enter_context(closing(CommittedShard(out, call.shard)))

        tar = TarShard(stack.enter_context(atomic_file(_staging(out, call.shard, call.token) / _staged("mjcf"))))
        for scene_id in sorted(call.scene_ids, key=tar_sort_key):
            try:
                rows[scene_id] = _add_scene(tar, out, call, scene_id, results.get(scene_id), load_committed)
            except (FileNotFoundError, FrameError):
                damaged.append(scene_id)
        tar.close()
    if damaged:
        remove_folder(_staging(out, call.shard, call.token))
        return StagedShard(call.token, 0, (), tuple(damaged))
    return _write_tables(out, call, rows)


def publish_shard(out: StoragePath, shard: int, staged: StagedShard, guard: Callable[[], None]) -> None:
    """Publish a staged shard (phase two).

    `guard` is called before each step that others see and raises if this process is no longer the writer.
    """
    guard()
    lines = ("ready", staged.token, *(f"{_WITHOUT}{table}" for table in staged.empty))
    write_atomic(_ready(out, shard), "".join(f"{line}\n" for line in lines).encode())
    _publish(out, shard, guard)


def discard_staged(out: StoragePath, call: CommitCall) -> None:
    """Remove what a lost worker staged."""
    remove_folder(_staging(out, call.shard, call.token))


def publish_ready(out: StoragePath, guard: Callable[[], None] = lambda: None) -> None:
    """Finish commits that a kill interrupted after their decision, and discard the others."""
    names = list_names(out / WORK)
    abort_uploads(out)
    for decided in filter(None, map(_DECIDED.fullmatch, names)):
        _publish(out, int(decided[1]), guard)
    for name in filter(_STAGED.fullmatch, names):
        remove_folder(out / WORK / name)


def _add_scene(
    tar: TarShard,
    out: StoragePath,
    call: CommitCall,
    scene_id: str,
    result: SceneResult | None,
    load_committed: Callable[[], CommittedShard],
) -> SceneRows:
    """Append a scene's files to the tar and make its rows."""
    if result is None:
        return load_committed().copy(scene_id, tar)
    own, place = None, None
    if result.part is not None:
        own = read_part_rows(out, call.shard, result.part)
        place = tar.append(read_part_files(out, call.shard, result.part))
    rows = complete_rows(result, own, call.shard, place)
    ran = {timing.stage for timing in result.timings}
    if ran and ran <= set(call.post_export) and is_committed(out, call.shard):
        return load_committed().merge_earlier_stages(scene_id, rows, call.post_export)
    return rows


def _write_tables(out: StoragePath, call: CommitCall, rows: Mapping[str, SceneRows]) -> StagedShard:
    """Write the tables; those without rows have no file."""
    size = sum(scene["tar_size"] or 0 for tables in rows.values() for scene in tables["scenes"])
    empty: list[str] = []
    for table, schema in STORED_TABLES.items():
        in_order = [row for scene_id in call.scene_ids for row in rows[scene_id][table]]
        if table in SPARSE and not in_order:
            empty.append(table)
            continue
        data = encode_parquet(build_table(in_order, schema))
        write_atomic(_staging(out, call.shard, call.token) / _staged(table), data)
        size += len(data)
    return StagedShard(call.token, size, tuple(empty))


def _publish(out: StoragePath, number: int, guard: Callable[[], None]) -> None:
    """Move the staged files into place; safe to repeat after a kill at any point."""
    decision = read_whole(_ready(out, number)).decode(errors="replace")
    if not _DECISION.fullmatch(decision):
        raise BuildError(f"{_ready(out, number)} is damaged: delete it, and the same command makes the shard again")
    _, token, *lines = decision.splitlines()
    staging = _staging(out, number, token)
    staged = set(list_names(staging))
    if _staged("scenes") in staged:  # otherwise all of them have been moved already
        guard()
        remove(shard_path(out, "scenes", number))
        _remove_emptied(out, lines, number)
    for folder in (*SPARSE, *FOLDERS):
        if _staged(folder) in staged:
            guard()
            move(staging / _staged(folder), shard_path(out, folder, number))
    remove(_ready(out, number))
    remove_folder(staging)


def _remove_emptied(out: StoragePath, lines: Sequence[str], number: int) -> None:
    """Remove the shard's older files in folders for which it has no rows any more."""
    for folder in (line.removeprefix(_WITHOUT) for line in lines):
        if folder in SPARSE and shard_name(folder, number) in list_names(out / folder):
            remove(shard_path(out, folder, number))


def _staging(out: StoragePath, number: int, token: str) -> StoragePath:
    return out / WORK / f"{shard_stem(number)}.{token}{STAGING}"


def _ready(out: StoragePath, number: int) -> StoragePath:
    return out / WORK / f"{shard_stem(number)}{READY}"


def _staged(table: str) -> str:
    return f"{table}.{(FOLDERS | SPARSE)[table]}"
