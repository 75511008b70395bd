"""Finished scenes of a shard that is not committed yet: a file of checksummed frames that only grows.

A frame is whole or it is not there: what a kill or a loss of power cut off is dropped when the journal is read. A
`reopen` frame takes a scene back (see `failures --retry`): its earlier results no longer count, neither in the journal
nor in the committed shard.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from schemas.codec import decode, encode
from schemas.work import SceneResult
from tableverse_factory.storage import cannot_write

_HEAD = struct.Struct("<4sBHQI")  # magic, what, bytes of the scene id, bytes of the payload, checksum of both
_MAGIC = b"TVJ1"
_RESULT, _REOPEN = 1, 2


@dataclass(frozen=True, slots=True)
class Entry:
    """Where a scene's encoded result stands in the file [bytes]."""

    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class Contents:
    """What a journal says.

    Attributes:
        results: The latest result of each scene.
        reopened: Scenes that were taken back; each needs a result here before its shard can be written again.
        end: Where the last whole frame ends [bytes].
    """

    results: dict[str, Entry]
    reopened: frozenset[str]
    end: int


class Journal:
    """The journal of one shard, open for appending: what `record` returned from survives a kill.

    Attributes:
        path: The file.
        results: The latest result of each scene.
        reopened: Scenes that were taken back.
    """

    def __init__(self, path: Path) -> None:
        """Opens or starts the journal and cuts off a torn last frame.

        Raises:
            BuildError: if the disk refuses.
        """
        contents = read_contents(path)
        self.path, self.results, self.reopened = path, contents.results, set(contents.reopened)
        self._end = contents.end
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
            self._file.truncate(self._end)
        except OSError as error:
            raise cannot_write(path, error) from error

    def record(self, result: SceneResult) -> None:
        """Appends a result.

        Raises:
            BuildError: if the disk is full; the journal is as before then.
        """
        payload = encode(result)
        self._append(_RESULT, result.scene_id, payload)
        self.results[result.scene_id] = Entry(self._end - len(payload), len(payload))

    def reopen(self, scene_id: str) -> None:
        """Appends that a scene is to be computed again.

        Raises:
            BuildError: if the disk is full.
        """
        self._append(_REOPEN, scene_id, b"")
        self.results.pop(scene_id, None)
        self.reopened.add(scene_id)

    def read(self, scene_id: str) -> SceneResult:
        """The latest result of a scene."""
        return read_result(self.path, self.results[scene_id])

    def close(self) -> None:
        """Closes the file; it stays on the disk."""
        self._file.close()

    def _append(self, what: int, scene_id: str, payload: bytes) -> None:
        name = scene_id.encode()
        head = _HEAD.pack(_MAGIC, what, len(name), len(payload), zlib.crc32(payload, zlib.crc32(name)))
        try:
            for part in (head + name, payload):
                self._write_all(part)
        except OSError as error:
            self._file.truncate(self._end)
            raise cannot_write(self.path, error) from error
        self._end += len(head) + len(name) + len(payload)

    def _write_all(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]


def read_result(path: Path, entry: Entry) -> SceneResult:
    """The result that stands at `entry`."""
    with path.open("rb") as file:
        file.seek(entry.offset)
        result: SceneResult = decode(file.read(entry.size))
    return result


def read_contents(path: Path, start: int = 0) -> Contents:
    """What a journal says, without changing it; a missing file says nothing.

    Args:
        path: The file.
        start: Where to begin: 0, or the `end` of an earlier look [bytes].
    """
    results: dict[str, Entry] = {}
    reopened: set[str] = set()
    end = start
    for what, scene_id, entry in _frames(path, start):
        if what == _RESULT:
            results[scene_id] = entry
        else:
            results.pop(scene_id, None)
            reopened.add(scene_id)
        end = entry.offset + entry.size
    return Contents(results, frozenset(reopened), end)


def _frames(path: Path, start: int) -> Iterator[tuple[int, str, Entry]]:
    """Whole frames from `start`, up to the first that is torn."""
    if not path.exists():
        return
    with path.open("rb") as file:
        file.seek(start)
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            magic, what, name_size, size, checksum = _HEAD.unpack(head)
            if magic != _MAGIC:
                return
            name = file.read(name_size)
            offset = file.tell()
            payload = file.read(size)
            if len(payload) < size or zlib.crc32(payload, zlib.crc32(name)) != checksum:
                return
            yield what, name.decode(), Entry(offset, size)
