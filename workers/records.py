"""What every stage gave, kept beside the dataset, so that nothing is computed or paid for twice, whatever dies.

A record's name says what it was made from: the scene, the stage, and a key over everything that the stage and those
before it have read. So a record is right wherever it is found, and one that another configuration left is never taken.
A record is written by the worker that made it and checked when it is read: one that a kill has torn counts as none, and
costs its computation. So it needs neither a rename nor a flush, which would cost more than many a stage.
"""

import json
import os
import struct
import zlib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
from upath import UPath

from schemas.config import Config
from schemas.identity import content_hash
from schemas.manifest import ImageRow
from tableverse_factory.stage import Stage
from tableverse_factory.storage import Place, cannot_write, names_in, read_whole, remove, remove_folder, write_atomic

RECORDS = ".stages"
MAX_BYTES = 4 * 1024**3
_HEAD = struct.Struct("<4sIQ")  # magic, checksum of what follows, bytes of the record itself
_MAGIC = b"TVR1"
_KEY_CHARS = 16


def stage_fingerprints(line: Sequence[Stage], config: Config, recorded: Mapping[str, object]) -> dict[str, str]:
    """A hash per stage over everything that decides its answer besides its input.

    Args:
        line: The stages.
        config: Of the build.
        recorded: What stages read besides their input and the configuration, by stage.
    """
    return {
        stage.name: content_hash(
            json.dumps([config.run.seed, stage.name, stage.values(config), recorded.get(stage.name)]).encode()
        )
        for stage in line
    }


def record_names(shard: int, row: ImageRow, fingerprints: Mapping[str, str]) -> tuple[str, ...]:
    """Names of what each stage of a line gives for a row; empty for the last, whose output is the scene's result.

    Args:
        shard: Where the scene stands.
        row: Of the manifest.
        fingerprints: Of the line's stages, in order.
    """
    key = content_hash(row.model_dump_json().encode())
    names = []
    for stage, fingerprint in fingerprints.items():
        key = content_hash(key.encode(), fingerprint.encode())
        names.append(f"{_folder(shard)}/{row.scene_id}.{stage}.{key[:_KEY_CHARS]}")
    return (*names[:-1], "")


def stage_of(name: str) -> str:
    """The stage whose output has this name."""
    return name.rsplit(".", 2)[1]


class Records:
    """All records, in a folder that every worker can write; a folder below it for each shard."""

    def __init__(self, folder: Place) -> None:
        """Nothing is made until something is written."""
        self._folder = folder

    def names(self, shard: int) -> set[str]:
        """Names of the records of a shard."""
        entries = names_in(self._folder / _folder(shard))
        return {f"{_folder(shard)}/{entry}" for entry in entries}

    def forget(self, shard: int, stages: Collection[str] | None = None) -> None:
        """Removes the records of a shard, or those of some stages of it.

        Raises:
            BuildError: if the disk refuses.
        """
        folder = self._folder / _folder(shard)
        if stages is None:
            remove_folder(folder)
            return
        for name in names_in(folder):
            if stage_of(name) in stages:
                remove(folder / name)

    def read(self, name: str) -> bytes | None:
        """A record; None where it is gone or damaged: it can be computed again."""
        try:
            data = read_whole(self._folder / name)
        except FileNotFoundError:
            return None
        if len(data) < _HEAD.size:
            return None
        magic, checksum, size = _HEAD.unpack_from(data)
        packed = memoryview(data)[_HEAD.size :]
        if magic != _MAGIC or size > MAX_BYTES or zlib.crc32(packed) != checksum:
            return None
        return bytes(pa.decompress(packed, decompressed_size=size, codec="zstd"))

    def write(self, name: str, record: bytes) -> None:
        """Keeps a record.

        Raises:
            BuildError: if the disk is full or refuses.
        """
        packed = pa.compress(record, codec="zstd", asbytes=True)
        data = _HEAD.pack(_MAGIC, zlib.crc32(packed), len(record)) + packed
        path = self._folder / name
        if isinstance(path, UPath):
            write_atomic(path, data)
            return
        try:
            _write(path, data)
        except OSError as error:
            with suppress(OSError):
                path.unlink()
            raise cannot_write(path, error) from error


def _write(path: Path, data: bytes) -> None:
    """Plainly, because stages may take less than Python's own files do."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o644)
    except FileNotFoundError:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, flags, 0o644)
    try:
        left = memoryview(data)
        while left:
            left = left[os.write(descriptor, left) :]
    finally:
        os.close(descriptor)


def _folder(shard: int) -> str:
    return f"shard-{shard:05d}"
