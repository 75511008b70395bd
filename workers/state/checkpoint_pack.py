"""Packs: files of checksummed frames, one per record, each appended to by one process and read by all.

A file per record would cost more than many a stage. Only the end of a pack can be torn, for whoever is killed never
appends again; so its frames are read up to the first that is not whole.
"""

import os
import struct
import zlib
from collections.abc import Collection, Iterator
from pathlib import Path

import pyarrow as pa

from tableverse_factory.core.storage.files import atomic_file, remove

MAX_BYTES = 4 * 1024**3
_HEAD = struct.Struct("<4sIHQQ")  # magic, checksum of all that follows, bytes of the name, packed, unpacked
_SUMMED = 8  # bytes of magic and checksum
_MAGIC = b"TVR1"


def stage_of(name: str) -> str:
    """The stage whose output has this name; empty for a name that is none of ours."""
    parts = name.rsplit(".", 2)
    return parts[1] if len(parts) == 3 else ""


def frame(name: str, record: bytes) -> bytes:
    """A record under its name, compressed."""
    packed: bytes = pa.compress(record, codec="zstd", asbytes=True)
    encoded = name.encode()
    head = _HEAD.pack(_MAGIC, 0, len(encoded), len(packed), len(record))[_SUMMED:]
    checksum = zlib.crc32(packed, zlib.crc32(encoded, zlib.crc32(head)))
    return b"".join((_MAGIC, checksum.to_bytes(4, "little"), head, encoded, packed))


def append(descriptor: int, framed: bytes) -> None:
    """Writes a frame to the end of a pack.

    Raises:
        OSError: if the disk is full or refuses.
    """
    left = memoryview(framed)
    while left:
        left = left[os.write(descriptor, left) :]


def frames(pack: Path) -> Iterator[tuple[str, int, int]]:
    """Name, offset and bytes of the frames of a pack, up to the first that is torn; what they hold is not read."""
    try:
        end = pack.stat().st_size
        with pack.open("rb") as file:
            offset = 0
            while len(head := file.read(_HEAD.size)) == _HEAD.size:
                magic, _, name_size, packed_size, _ = _HEAD.unpack(head)
                size = _HEAD.size + name_size + packed_size
                if magic != _MAGIC or offset + size > end:
                    return
                name = file.read(name_size).decode(errors="replace")
                if stage_of(name):
                    yield name, offset, size
                offset += size
                file.seek(offset)
    except FileNotFoundError:
        return


def unpacked_at(pack: Path, offset: int) -> bytes | None:
    """The record in the frame at an offset; None where it is damaged.

    Raises:
        FileNotFoundError: if there is no such pack.
    """
    with pack.open("rb") as file:
        file.seek(offset)
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return None
        _, _, name_size, packed_size, _ = _HEAD.unpack(head)
        if packed_size > MAX_BYTES:
            return None
        return unpacked(head + file.read(name_size + packed_size))


def unpacked(framed: bytes) -> bytes | None:
    """The record in a frame; None where it is damaged."""
    if len(framed) < _HEAD.size:
        return None
    magic, checksum, name_size, packed_size, size = _HEAD.unpack_from(framed)
    rest = memoryview(framed)[_HEAD.size :]
    if magic != _MAGIC or size > MAX_BYTES or len(rest) != name_size + packed_size:
        return None
    if zlib.crc32(memoryview(framed)[_SUMMED:]) != checksum:
        return None
    record: bytes = pa.decompress(rest[name_size:], decompressed_size=size, codec="zstd", asbytes=True)
    return record


def compact(pack: Path, stages: Collection[str]) -> None:
    """Writes a pack anew without the records of some stages; one that is empty goes."""
    found = list(frames(pack))
    kept = [(offset, size) for name, offset, size in found if stage_of(name) not in stages]
    if len(kept) == len(found):
        return
    if kept:
        with atomic_file(pack) as new, pack.open("rb") as old:
            for offset, size in kept:
                old.seek(offset)
                new.write(old.read(size))
    else:
        remove(pack)
