"""Journal of a shard on the disk: one append-only file; a torn tail is dropped."""

import os
from dataclasses import replace
from pathlib import Path

from schemas.codec import decode
from schemas.work import SceneResult
from tableverse_factory.core.framing import encode_header
from tableverse_factory.core.storage.files import make_write_error
from workers.state.journal_frames import Journal, JournalEntry, JournalState, fold_frames, scan_journal


class FileJournal(Journal):
    """Journal file, in which a recorded result survives a kill."""

    def __init__(self, path: Path) -> None:
        """Open or create the journal and cut off a torn last frame."""
        state = read_file_journal(path)
        super().__init__(state)
        self._path, self._end = path, state.end
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
            self._file.truncate(self._end)
        except OSError as error:
            raise make_write_error(path, error) from error

    def read(self, scene_id: str) -> SceneResult:
        """Read the latest result of a scene."""
        return read_file_result(self._path, self.results[scene_id])

    def tick(self) -> None:
        """Do nothing: every result is on the disk when it is recorded."""

    def close(self) -> None:
        """Close the file, which stays."""
        self._file.close()

    def remove(self) -> None:
        """Close and delete the file."""
        self._file.close()
        self._path.unlink()

    def _append(self, kind: bytes, scene_id: str, payload: bytes) -> JournalEntry:
        """Append a frame; if the disk is full, the journal stays as before."""
        header = encode_header(payload, kind + scene_id.encode())
        try:
            for part in (header, payload):
                left = memoryview(part)
                while left:
                    left = left[self._file.write(left) :]
        except OSError as error:
            self._file.truncate(self._end)
            raise make_write_error(self._path, error) from error
        entry = JournalEntry(self._end + len(header), len(payload))
        self._end = entry.offset + entry.size
        return entry


def read_file_result(path: Path, entry: JournalEntry) -> SceneResult:
    """Read the result at `entry`."""
    with path.open("rb") as file:
        file.seek(entry.offset)
        result: SceneResult = decode(file.read(entry.size))
    return result


def read_file_journal(path: Path, start: int = 0) -> JournalState:
    """Read the journal from `start` on without changing it; a missing file is empty."""
    try:
        with path.open("rb") as file:
            state = fold_frames(scan_journal(file, start), start)
            return replace(state, lost=max(os.fstat(file.fileno()).st_size - state.end, 0))
    except (FileNotFoundError, NotADirectoryError):
        return JournalState({}, frozenset(), start)
