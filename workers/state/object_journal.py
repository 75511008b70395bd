"""Journal of a shard in an object store: numbered objects of whole frames, since objects cannot be appended to.

Results are buffered until they amount to 8 MB or the oldest is a second old, then written as one object, whose name is
the offset of its first byte in the journal. A kill loses the buffer; its scenes are recomputed.
"""

import io
import time

from upath import UPath

from schemas.codec import decode
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import encode_header
from tableverse_factory.core.storage.files import (
    get_store,
    list_names,
    list_sizes,
    make_write_error,
    read_range,
    read_whole,
    remove_folder,
)
from workers.state.journal_frames import (
    RESULT,
    Journal,
    JournalEntry,
    JournalFrame,
    JournalState,
    fold_frames,
    scan_journal,
)

MAX_BUFFER_BYTES = 8 * 1024**2
MAX_BUFFER_AGE_S = 1.0


class ObjectJournal(Journal):
    """Journal in a store, which buffers results."""

    def __init__(self, folder: UPath) -> None:
        """Read the journal; the first result creates the first object."""
        state = read_object_journal(folder)
        super().__init__(state)
        self._folder, self._start = folder, state.end
        self._buffer = bytearray()
        self._since = 0.0
        self._refused = False

    def read(self, scene_id: str) -> SceneResult:
        """Read the latest result of a scene."""
        entry = self.results[scene_id]
        if entry.segment < self._start:
            return read_object_result(self._folder, entry)
        first = entry.offset - self._start
        return decode(bytes(self._buffer[first : first + entry.size]))

    def tick(self) -> None:
        """Write the buffer if it is old enough."""
        if self._buffer and time.monotonic() - self._since >= MAX_BUFFER_AGE_S:
            self._flush()

    def close(self) -> None:
        """Write the buffer, unless the store has just refused it."""
        if not self._refused:
            self._flush()

    def remove(self) -> None:
        """Delete the journal and the buffer."""
        self._buffer.clear()
        remove_folder(self._folder)

    def _append(self, kind: bytes, scene_id: str, payload: bytes) -> JournalEntry:
        if not self._buffer:
            self._since = time.monotonic()
        self._buffer += encode_header(payload, kind + scene_id.encode())
        entry = JournalEntry(self._start + len(self._buffer), len(payload), self._start)
        self._buffer += payload
        if kind == RESULT and len(self._buffer) >= MAX_BUFFER_BYTES:
            self._flush()
        return entry

    def _flush(self) -> None:
        if not self._buffer:
            return
        path = self._folder / _object_name(self._start)
        self._refused = True
        try:
            etag = get_store(path).put_if_absent(path.path, bytes(self._buffer))
        except OSError as error:
            raise make_write_error(path, error) from error
        if etag is None:
            raise BuildError(
                f"{path} was written by another process, so this one stops. Finished scenes are kept: when no other "
                "build of this dataset runs, run the same command to go on"
            )
        self._refused = False
        self._start += len(self._buffer)
        self._buffer.clear()


def read_object_result(folder: UPath, entry: JournalEntry) -> SceneResult:
    """Read the result at `entry` and nothing else."""
    data = read_range(folder / _object_name(entry.segment), entry.offset - entry.segment, entry.size)
    return decode(data)


def read_object_journal(folder: UPath, start: int = 0) -> JournalState:
    """Read the objects from `start` on (0 or an earlier end); a damaged object loses only its own frames."""
    frames: list[JournalFrame] = []
    end, lost = start, 0
    for name in list_names(folder):
        first = int(name)
        if first < start:
            continue
        data = read_whole(folder / name)
        whole = list(scan_journal(io.BytesIO(data), 0, first))
        end = first + len(data)
        lost += end - fold_frames(whole, first).end
        frames += whole
    state = fold_frames(frames, start)
    return JournalState(state.results, state.reopened, end, lost)


def find_objects_end(folder: UPath) -> int:
    """Find where the last object ends [bytes]; 0 if there is none."""
    return max((int(name) + size for name, size in list_sizes(folder).items()), default=0)


def _object_name(start: int) -> str:
    return f"{start:015d}"
