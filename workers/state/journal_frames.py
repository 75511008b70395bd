"""Checksummed frames, of which journals are made: a frame is whole or it is not there.

A result frame holds a finished scene. A `reopen` frame takes a scene back (see `failures --retry`): its earlier results
no longer count, neither in the journal nor in the committed shard.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

RESULT, REOPEN = 1, 2
_HEAD = struct.Struct("<4sBHQI")  # magic, what, bytes of the scene id, bytes of the payload, checksum of both
_MAGIC = b"TVJ1"


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """Where a scene's encoded result stands in its journal [bytes].

    Attributes:
        segment: Where the piece of the journal begins that holds it; 0 where the journal is one file.
    """

    offset: int
    size: int
    segment: int = 0


@dataclass(frozen=True, slots=True)
class JournalFrame:
    """A frame as it was read: a result, or a scene taken back (`entry.size` is 0 then)."""

    what: int
    scene_id: str
    entry: JournalEntry


@dataclass(frozen=True, slots=True)
class JournalState:
    """What a journal says.

    Attributes:
        results: The latest result of each scene.
        reopened: Scenes that were taken back; each needs a result here before its shard can be written again.
        end: Where the last whole frame ends [bytes].
        lost: What stands there and is no whole frame: a kill cut it off, or the disk damaged it [bytes].
    """

    results: dict[str, JournalEntry]
    reopened: frozenset[str]
    end: int
    lost: int = 0


NOTHING = JournalState({}, frozenset(), 0)
"""What a journal says that is not there."""


def pack(what: int, scene_id: str, payload: bytes) -> tuple[bytes, bytes]:
    """A frame in two parts: head with the scene's id, and the payload."""
    name = scene_id.encode()
    checksum = zlib.crc32(payload, zlib.crc32(name))
    return _HEAD.pack(_MAGIC, what, len(name), len(payload), checksum) + name, payload


def unpack(stream: BinaryIO, start: int, segment: int = 0) -> Iterator[JournalFrame]:
    """Whole frames from the stream's place on, up to the first that is torn.

    Args:
        stream: What holds the frames.
        start: Where in the journal the stream stands [bytes].
        segment: See `JournalEntry`.
    """
    while len(head := stream.read(_HEAD.size)) == _HEAD.size:
        magic, what, name_size, size, checksum = _HEAD.unpack(head)
        if magic != _MAGIC:
            return
        name = stream.read(name_size)
        payload = stream.read(size)
        if len(payload) < size or zlib.crc32(payload, zlib.crc32(name)) != checksum:
            return
        offset = start + _HEAD.size + name_size
        start = offset + size
        yield JournalFrame(what, name.decode(), JournalEntry(offset, size, segment))


def contents_of(frames: Iterable[JournalFrame], end: int) -> JournalState:
    """What frames say together; `end` is where they begin."""
    results: dict[str, JournalEntry] = {}
    reopened: set[str] = set()
    for frame in frames:
        if frame.what == RESULT:
            results[frame.scene_id] = frame.entry
        else:
            results.pop(frame.scene_id, None)
            reopened.add(frame.scene_id)
        end = frame.entry.offset + frame.entry.size
    return JournalState(results, frozenset(reopened), end)
