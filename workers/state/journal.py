"""Writers of journals: results of scenes whose shard is not committed yet (see `dataset.journals`)."""

import os
import time
from abc import ABC, abstractmethod
from pathlib import Path

from upath import UPath

from schemas.codec import encode
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import encode_header
from tableverse_factory.core.storage.append_files import append_whole
from tableverse_factory.core.storage.files import (
    StoragePath,
    get_store,
    remove_folder,
    sync_folder,
    translate_write_errors,
)
from tableverse_factory.dataset.journals import REOPEN, RESULT, read_journal, segment_name

MAX_BUFFER_BYTES = 8 * 1024**2
MAX_BUFFER_AGE_S = 1.0


class Journal(ABC):
    """Journal of one shard, open for appending by one writer.

    Every method raises BuildError if the disk or the store refuses, or another process writes this journal.
    """

    def __init__(self, path: StoragePath) -> None:
        """Open or create the journal."""
        try:
            self._end = read_journal(path).end
        except OSError as error:
            why = f"cannot read {path}: {error.strerror or error}: mend the disk or the permissions"
            raise BuildError(f"{why}, then run the same command to go on") from error

    def record(self, result: SceneResult) -> None:
        """Append a result; it survives a kill at once on the disk, after about a second in a store."""
        payload = encode(result)
        self._append(encode_header(payload, RESULT + result.scene_id.encode()) + payload)

    def reopen(self, scene_id: str) -> None:
        """Append that a scene must be recomputed; durable once the journal is flushed."""
        self._append(encode_header(b"", REOPEN + scene_id.encode()))

    @abstractmethod
    def tick(self) -> None:
        """Write results that have waited long enough; called several times a second."""

    @abstractmethod
    def flush(self) -> None:
        """Write what waits; then it survives a loss of power, and all machines see it."""

    @abstractmethod
    def close(self) -> None:
        """Write what waits; the journal stays."""

    @abstractmethod
    def remove(self) -> None:
        """Delete the journal, whose shard is committed."""

    @abstractmethod
    def _append(self, frame: bytes) -> None:
        """Append a frame."""


class FileJournal(Journal):
    """Journal file, in which a recorded result survives a kill."""

    def __init__(self, path: Path) -> None:
        """Open or create the journal and cut off a torn last frame."""
        super().__init__(path)
        self._path = path
        with translate_write_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
            self._file.truncate(self._end)

    def tick(self) -> None:
        """Do nothing: every result is on the disk when it is recorded."""

    def flush(self) -> None:
        """Flush the file and its name; before, other machines of a network file system may not see all of it."""
        with translate_write_errors(self._path):
            os.fsync(self._file.fileno())
            sync_folder(self._path.parent)

    def close(self) -> None:
        """Close the file, which stays."""
        with translate_write_errors(self._path):
            self._file.close()

    def remove(self) -> None:
        """Close and delete the file."""
        with translate_write_errors(self._path):
            self._file.close()
            self._path.unlink()

    def _append(self, frame: bytes) -> None:
        """Append a frame; if the disk is full, the journal stays as before."""
        with translate_write_errors(self._path):
            append_whole(self._file.fileno(), [frame], self._end)
        self._end += len(frame)


class ObjectJournal(Journal):
    """Journal in a store: results are buffered until they amount to 8 MB or the oldest is a second old.

    A kill loses the buffer; its scenes are recomputed.
    """

    def __init__(self, folder: UPath) -> None:
        """Read the journal; the first result creates the first object."""
        super().__init__(folder)
        self._folder = folder
        self._buffer = bytearray()
        self._since = 0.0
        self._refused = False

    def tick(self) -> None:
        """Write the buffer if it is old enough."""
        if self._buffer and time.monotonic() - self._since >= MAX_BUFFER_AGE_S:
            self.flush()

    def close(self) -> None:
        """Write the buffer, unless the store has just refused it."""
        if not self._refused:
            self.flush()

    def remove(self) -> None:
        """Delete the journal and the buffer."""
        self._buffer.clear()
        remove_folder(self._folder)

    def flush(self) -> None:
        """Write the buffer as one object, which no other process may have written."""
        if not self._buffer:
            return
        path = self._folder / segment_name(self._end)
        self._refused = True
        with translate_write_errors(path):
            etag = get_store(path).put_if_absent(path.path, bytes(self._buffer))
        if etag is None:
            raise BuildError(
                f"{path} was written by another process, so this one stops. Finished scenes are kept: when no other "
                "build of this dataset runs, run the same command to go on"
            )
        self._refused = False
        self._end += len(self._buffer)
        self._buffer.clear()

    def _append(self, frame: bytes) -> None:
        if not self._buffer:
            self._since = time.monotonic()
        self._buffer += frame
        if len(self._buffer) >= MAX_BUFFER_BYTES:
            self.flush()


def open_journal(path: StoragePath) -> Journal:
    """Open or create a journal."""
    return ObjectJournal(path) if isinstance(path, UPath) else FileJournal(path)
