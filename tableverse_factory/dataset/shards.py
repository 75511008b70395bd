"""Shards whose bytes depend on their content alone: sorted USTAR without a clock, Parquet with fixed settings."""

import io
import re
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any, BinaryIO

import pyarrow as pa

from schemas.scene import ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TRAJECTORIES
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.trajectory_files import find_misfits

# Folders of OUT and the suffix of their shards, in the order in which the files appear; the last is the commit
FOLDERS = {"mjcf": "tar", "objects": "parquet", "tasks": "parquet", "timings": "parquet", "scenes": "parquet"}
SPARSE = {"trajectories": "parquet"}  # folders in which a shard has a file only if it has rows for it

_COPY_BYTES = 1024 * 1024
_PARQUET = re.compile(r"shard-(\d{5,9})\.parquet")


class TarShard:
    """USTAR file written front to back; members carry no owner, no clock and mode 0644.

    Add scenes in the order of `tar_sort_key`, so that all member names in the file are sorted.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._tar = tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115 closed in close

    def add(self, scene: ExportedScene) -> tuple[int, int]:
        """Append a scene's members; return the offset of its first header and its length, padding included [bytes]."""
        start = self._tar.offset
        for name, data in scene.files:
            self._tar.addfile(_make_member(scene.scene_id, name, len(data)), io.BytesIO(data))
        return start, self._tar.offset - start

    def append(self, members: bytes) -> tuple[int, int]:
        """Append a scene's members as `add` wrote them elsewhere; return their offset and size here [bytes]."""
        start = self._tar.offset
        self._file.write(members)
        self._tar.offset += len(members)
        return start, len(members)

    def copy(self, source: BinaryIO, offset: int, size: int) -> tuple[int, int]:
        """Append a scene's members as they are in another shard; return their offset and size here [bytes]."""
        start = self._tar.offset
        source.seek(offset)
        left = size
        while left:
            block = source.read(min(left, _COPY_BYTES))
            if not block:
                raise BuildError(f"a committed shard ends {left} bytes too early: it was changed after its commit")
            self._file.write(block)
            left -= len(block)
        self._tar.offset += size
        return start, size

    def close(self) -> None:
        """Write the end of the archive; the file stays open."""
        self._tar.close()


def shard_path(out: StoragePath, folder: str, number: int) -> StoragePath:
    """Path of a shard's file in a folder, e.g. `OUT/scenes/shard-00000.parquet`."""
    return out / folder / shard_name(folder, number)


def shard_name(folder: str, number: int) -> str:
    """Name of a shard's file in a folder."""
    return f"{shard_stem(number)}.{(FOLDERS | SPARSE)[folder]}"


def shard_stem(number: int) -> str:
    """Name of a shard, e.g. `shard-00000`."""
    return f"shard-{number:05d}"


def is_committed(out: StoragePath, number: int) -> bool:
    """Return whether the shard is committed: its scenes file is written last."""
    return shard_path(out, "scenes", number).exists()


def committed_shards(out: StoragePath) -> frozenset[int]:
    """List the committed shards with one request."""
    return find_shards(list_names(out / "scenes"))


def find_shards(names: Iterable[str]) -> frozenset[int]:
    """Find the numbers of the shards whose Parquet files are among these names."""
    return frozenset(int(match[1]) for match in map(_PARQUET.fullmatch, names) if match)


def tar_sort_key(scene_id: str) -> str:
    """Key that sorts scenes as their member names sort (`a-b/x` before `a/x`)."""
    return scene_id + "/"


def check_exported(scene: ExportedScene, scene_id: str) -> None:
    """Check that a scene can be committed, so that writing its shard cannot fail later."""
    if scene.scene_id != scene_id:
        raise BuildError(f"the exported scene is called {scene.scene_id[:100]!r}, not {scene_id!r}")
    names = [name for name, _ in scene.files]
    if names != sorted(set(names)):
        raise BuildError("the files of an exported scene must be sorted by name, each once")
    for name in names:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or str(path) != name or not name.isprintable():
            raise BuildError(f"{name[:200]!r} is no safe name for a file of a scene")
        try:
            _make_member(scene_id, name, 0).tobuf(tarfile.USTAR_FORMAT, "ascii", "strict")
        except (ValueError, UnicodeError) as error:
            raise BuildError(f"{name[:200]!r} does not fit a USTAR header: {error}") from error
    for what, schema, rows in (
        ("scene", SCENES, (scene.scene_row,)),
        ("object", OBJECTS, scene.object_rows),
        ("task", TASKS, scene.task_rows),
        ("trajectory", TRAJECTORIES, scene.trajectory_rows),
    ):
        check_rows(what, schema, rows)
    if any(row["scene_id"] != scene_id for row in (*scene.object_rows, *scene.task_rows, *scene.trajectory_rows)):
        raise BuildError("every row of an object, a task or a trajectory must name its scene in scene_id")
    task_ids = [str(row["task_id"]) for row in scene.task_rows]
    for misfit in find_misfits(scene.trajectory_rows, dict(scene.files), task_ids):
        raise BuildError(misfit)


def check_rows(what: str, schema: pa.Schema, rows: Sequence[Mapping[str, Any]]) -> None:
    """Check that rows fit their table."""
    for row in rows:
        unknown = sorted(set(row) - set(schema.names))
        if unknown:
            raise BuildError(f"unknown columns {unknown[:5]} in a row of the {what} table")
    try:
        given = dict.fromkeys(name for row in rows for name, value in row.items() if value is not None)
        for name in given:  # most columns of a row are empty: they cost nothing
            pa.array([row.get(name) for row in rows], schema.field(name).type)
    except (pa.ArrowException, OverflowError, TypeError, ValueError) as error:
        raise BuildError(f"a row does not fit the {what} table: {' '.join(str(error).split())[:300]}") from error


def advise_repair(path: StoragePath) -> str:
    """Advise what to do about a damaged file of a shard."""
    return f"delete scenes/{path.stem}.parquet, and the same build makes the shard again"


def _make_member(scene_id: str, name: str, size: int) -> tarfile.TarInfo:
    member = tarfile.TarInfo(f"{scene_id}/{name}")
    member.size, member.mtime, member.mode = size, 0, 0o644
    return member
