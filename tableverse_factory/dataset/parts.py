"""Parts: finished scenes whose shard is not committed yet, each written once, by the worker that made it.

A part is a frame with the scene's rows and one with its files, as they will stand in the tar of the shard. On the disk
each process appends to its own file; in a store each part is an object. Only the parts that the journal of the shard
names count; the others are of processes that were killed before their result was known.
"""

import io
import re
from collections.abc import Iterable
from pathlib import Path
from secrets import token_hex
from typing import Any

from upath import UPath

from schemas.codec import decode, encode
from schemas.scene import ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TRAJECTORIES, normalize_row
from schemas.work import ScenePart
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import HEADER_BYTES, FrameError, encode_header, read_frame
from tableverse_factory.core.storage.append_files import AppendFiles
from tableverse_factory.core.storage.files import StoragePath, read_range, write_atomic
from tableverse_factory.dataset.journals import WORK
from tableverse_factory.dataset.shards import TarShard, check_rows, shard_stem

_SUFFIX = ".parts"
_NAME = re.compile(rf"shard-(\d{{5,9}}){re.escape(_SUFFIX)}")
_LABELS = (b"rows", b"files")
_SCHEMAS = {"scenes": SCENES, "objects": OBJECTS, "tasks": TASKS, "trajectories": TRAJECTORIES}

SceneRows = dict[str, list[dict[str, Any]]]  # the rows of one scene in each table


def parts_folder(out: StoragePath, shard: int) -> StoragePath:
    """Folder of the parts of a shard."""
    return out / WORK / f"{shard_stem(shard)}{_SUFFIX}"


def find_parts(names: Iterable[str]) -> frozenset[int]:
    """Find the shards with parts among the names in `.work/`."""
    return frozenset(int(match[1]) for match in map(_NAME.fullmatch, names) if match)


def files_offset(part: ScenePart) -> int:
    """Position of the first tar header of a part in its file [bytes]."""
    return part.offset + part.rows_size + 2 * HEADER_BYTES + sum(map(len, _LABELS))


class PartWriter:
    """Writer of the parts that this process makes."""

    def __init__(self, out: StoragePath) -> None:
        """Nothing is created until a part is written."""
        self._out, self._files = out, AppendFiles(_SUFFIX)

    def write(self, shard: int, scene: ExportedScene) -> ScenePart:
        """Write a scene and return its place."""
        rows, files = _encode_rows(scene), _encode_files(scene)
        frames = [piece for data, label in zip((rows, files), _LABELS, strict=True) for piece in _frame(data, label)]
        folder = parts_folder(self._out, shard)
        if isinstance(folder, UPath):
            name, offset = f"{scene.scene_id}-{token_hex(8)}{_SUFFIX}", 0
            write_atomic(folder / name, b"".join(frames))
        else:
            name, offset = self._files.append(Path(folder), *frames)
        return ScenePart(name, offset, len(rows), len(files))


def read_part_rows(out: StoragePath, shard: int, part: ScenePart) -> SceneRows:
    """Read the rows that the scene itself determines; FrameError if they are damaged, FileNotFoundError if gone."""
    data = _read_frame(out, shard, part, part.offset, _LABELS[0], part.rows_size)
    try:
        rows = dict(zip(_SCHEMAS, decode(data), strict=True))
        (_,) = rows["scenes"]
        for name, schema in _SCHEMAS.items():
            check_rows(name, schema, rows[name])
        return {name: [normalize_row(row, schema) for row in rows[name]] for name, schema in _SCHEMAS.items()}
    except (AttributeError, TypeError, ValueError, BuildError) as error:
        raise FrameError(f"no rows of a scene: {error}") from error


def read_part_files(out: StoragePath, shard: int, part: ScenePart) -> bytes:
    """Read the members of a tar with the scene's files; errors as of `read_part_rows`."""
    start = files_offset(part) - HEADER_BYTES - len(_LABELS[1])
    return _read_frame(out, shard, part, start, _LABELS[1], part.files_size)


def _encode_rows(scene: ExportedScene) -> bytes:
    tables = ((scene.scene_row,), scene.object_rows, scene.task_rows, scene.trajectory_rows)
    return encode(tuple([{k: v for k, v in row.items() if v is not None} for row in rows] for rows in tables))


def _encode_files(scene: ExportedScene) -> bytes:
    buffer = io.BytesIO()
    _, size = TarShard(buffer).add(scene)
    return buffer.getvalue()[:size]


def _frame(data: bytes, label: bytes) -> tuple[bytes, bytes]:
    return encode_header(data, label), data


def _read_frame(out: StoragePath, shard: int, part: ScenePart, start: int, label: bytes, size: int) -> bytes:
    data = read_range(parts_folder(out, shard) / part.file, start, HEADER_BYTES + len(label) + size)
    found, payload = read_frame(io.BytesIO(data).read)
    if found != label:
        raise FrameError(f"{label.decode()} of another frame")
    return payload
