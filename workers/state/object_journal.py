"""The journal of a shard in an object store, where nothing can be appended to: numbered objects of whole frames.

Results wait in memory until there are 8 MB of them or the oldest has waited a second, and become one object then. Its
name is the place of its first byte in the journal, so that places mean the same here as in a file. A kill costs what
waited: these scenes are computed again.
"""

import io
import time

from upath import UPath

from schemas.codec import decode, encode
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import (
    list_names,
    read_range,
    read_whole,
    remove_folder,
    get_store,
    write_error,
)
from workers.state.journal_frames import (
    REOPEN,
    RESULT,
    JournalEntry,
    JournalFrame,
    JournalState,
    contents_of,
    pack,
    unpack,
)

MAX_WAITING_BYTES = 8 * 1024**2
MAX_WAITING_S = 1.0


class ObjectJournal:
    """Open for adding: what `record` was given is in the store about a second later (see `workers.state.journal.Journal`)."""

    def __init__(self, folder: UPath) -> None:
        """Reads what is there; the first result makes the first object.

        Raises:
            StoreError: if the store refuses or does not answer.
        """
        contents = read_segments(folder)
        self.results, self.reopened = contents.results, set(contents.reopened)
        self._folder, self._start = folder, contents.end
        self._waiting = bytearray()
        self._since = 0.0
        self._refused = False

    def record(self, result: SceneResult) -> None:
        """Adds a result.

        Raises:
            BuildError: if it is written now, and the store refuses or another process writes this journal.
        """
        payload = encode(result)
        end = self._add(RESULT, result.scene_id, payload)
        self.results[result.scene_id] = JournalEntry(end - len(payload), len(payload), self._start)
        if len(self._waiting) >= MAX_WAITING_BYTES:
            self._flush()

    def reopen(self, scene_id: str) -> None:
        """Adds that a scene is to be computed again."""
        self._add(REOPEN, scene_id, b"")
        self.results.pop(scene_id, None)
        self.reopened.add(scene_id)

    def read(self, scene_id: str) -> SceneResult:
        """The latest result of a scene."""
        entry = self.results[scene_id]
        if entry.segment < self._start:
            return read_from_segment(self._folder, entry)
        first = entry.offset - self._start
        result: SceneResult = decode(bytes(self._waiting[first : first + entry.size]))
        return result

    def tick(self) -> None:
        """Writes what has waited long enough.

        Raises:
            BuildError: as `record`.
        """
        if self._waiting and time.monotonic() - self._since >= MAX_WAITING_S:
            self._flush()

    def close(self) -> None:
        """Writes what waits, unless the store has just refused that: once is enough to wait for.

        Raises:
            BuildError: as `record`.
        """
        if not self._refused:
            self._flush()

    def remove(self) -> None:
        """Removes all of it, also what waits."""
        self._waiting.clear()
        remove_folder(self._folder)

    def _add(self, what: int, scene_id: str, payload: bytes) -> int:
        """Where the frame ends in the journal."""
        if not self._waiting:
            self._since = time.monotonic()
        for part in pack(what, scene_id, payload):
            self._waiting += part
        return self._start + len(self._waiting)

    def _flush(self) -> None:
        if not self._waiting:
            return
        path = self._folder / _name(self._start)
        self._refused = True
        try:
            etag = get_store(path).put_if_absent(path.path, bytes(self._waiting))
        except OSError as error:
            raise write_error(path, error) from error
        if etag is None:
            raise BuildError(
                f"{path} was written by another process: this one stops. Finished scenes are kept: when no other build "
                "of this dataset runs, run the same command to go on"
            )
        self._refused = False
        self._start += len(self._waiting)
        self._waiting.clear()


def read_from_segment(folder: UPath, entry: JournalEntry) -> SceneResult:
    """The result that stands at `entry`; nothing else is read."""
    data = read_range(folder / _name(entry.segment), entry.offset - entry.segment, entry.size)
    result: SceneResult = decode(data)
    return result


def read_segments(folder: UPath, start: int = 0) -> JournalState:
    """What the objects say from `start` on, which is 0 or an earlier end; a damaged one costs its own frames alone."""
    frames: list[JournalFrame] = []
    end, lost = start, 0
    for name in list_names(folder):
        first = int(name)
        if first < start:
            continue
        data = read_whole(folder / name)
        whole = list(unpack(io.BytesIO(data), first, first))
        end = first + len(data)
        lost += end - contents_of(whole, first).end
        frames += whole
    contents = contents_of(frames, start)
    return JournalState(contents.results, contents.reopened, end, lost)


def end_of_segments(folder: UPath) -> int:
    """Where the last object ends [bytes]; 0 where there is none."""
    return max((int(name) + size for name, size in get_store(folder).list_sizes(folder.path).items()), default=0)


def _name(start: int) -> str:
    return f"{start:015d}"
