"""The journal of a shard on the disk: one file that only grows; what a kill or a loss of power cut off is dropped."""

import os
from dataclasses import replace
from pathlib import Path

from schemas.codec import decode, encode
from schemas.work import SceneResult
from tableverse_factory.core.storage.files import write_error
from workers.state.journal_frames import REOPEN, RESULT, JournalEntry, JournalState, contents_of, pack, unpack


class FileJournal:
    """Open for appending: what `record` returned from survives a kill (see `workers.state.journal.Journal`)."""

    def __init__(self, path: Path) -> None:
        """Opens or starts the journal and cuts off a torn last frame.

        Raises:
            BuildError: if the disk refuses.
        """
        contents = read_file(path)
        self.results, self.reopened = contents.results, set(contents.reopened)
        self._path, self._end = path, contents.end
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("ab", buffering=0)
            self._file.truncate(self._end)
        except OSError as error:
            raise write_error(path, error) from error

    def record(self, result: SceneResult) -> None:
        """Appends a result.

        Raises:
            BuildError: if the disk is full; the journal is as before then.
        """
        payload = encode(result)
        self._append(RESULT, result.scene_id, payload)
        self.results[result.scene_id] = JournalEntry(self._end - len(payload), len(payload))

    def reopen(self, scene_id: str) -> None:
        """Appends that a scene is to be computed again.

        Raises:
            BuildError: if the disk is full.
        """
        self._append(REOPEN, scene_id, b"")
        self.results.pop(scene_id, None)
        self.reopened.add(scene_id)

    def read(self, scene_id: str) -> SceneResult:
        """The latest result of a scene."""
        return read_from_file(self._path, self.results[scene_id])

    def tick(self) -> None:
        """Nothing waits: every result is on the disk when it is recorded."""

    def close(self) -> None:
        """Closes the file; it stays on the disk."""
        self._file.close()

    def remove(self) -> None:
        """Closes the file and removes it."""
        self._file.close()
        self._path.unlink()

    def _append(self, what: int, scene_id: str, payload: bytes) -> None:
        parts = pack(what, scene_id, payload)
        try:
            for part in parts:
                self._write_all(part)
        except OSError as error:
            self._file.truncate(self._end)
            raise write_error(self._path, error) from error
        self._end += sum(len(part) for part in parts)

    def _write_all(self, data: bytes) -> None:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]


def read_from_file(path: Path, entry: JournalEntry) -> SceneResult:
    """The result that stands at `entry`."""
    with path.open("rb") as file:
        file.seek(entry.offset)
        result: SceneResult = decode(file.read(entry.size))
    return result


def end_of_file(path: Path) -> int:
    """Where the file ends [bytes]; 0 where there is none."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def read_file(path: Path, start: int = 0) -> JournalState:
    """What the file says from `start` on, without changing it; a missing file says nothing."""
    try:
        with path.open("rb") as file:
            file.seek(start)
            contents = contents_of(unpack(file, start), start)
            return replace(contents, lost=max(os.fstat(file.fileno()).st_size - contents.end, 0))
    except (FileNotFoundError, NotADirectoryError):
        return JournalState({}, frozenset(), start)
