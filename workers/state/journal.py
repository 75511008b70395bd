"""Finished scenes of a shard that is not committed yet: an append-only file, or objects in a store."""

import os
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from upath import UPath

from schemas.codec import decode
from schemas.work import SceneResult
from tableverse_factory.core.framing import encode_header
from tableverse_factory.core.storage.files import StoragePath, make_write_error
from workers.state.journal_frames import Journal, JournalEntry, JournalState, fold_frames, scan_journal
from workers.state.object_journal import ObjectJournal, find_objects_end, read_object_journal, read_object_result

SUFFIX = ".journal"
_NAME = re.compile(rf"shard-(\d{{5,9}}){re.escape(SUFFIX)}")


class FileJournal(Journal):
    """Journal file, in which a recorded result survives a kill."""

    def __init__(self, path: Path) -> None:
        """Open or create the journal and cut off a torn last frame."""
        state = read_journal(path)
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
        return read_result(self._path, self.results[scene_id])

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


def open_journal(path: StoragePath) -> Journal:
    """Open or create a journal."""
    return ObjectJournal(path) if isinstance(path, UPath) else FileJournal(path)


def read_journal(path: StoragePath, start: int = 0) -> JournalState:
    """Read a journal from `start` [bytes], 0 or an earlier end, without changing it; a missing one is empty."""
    if isinstance(path, UPath):
        return read_object_journal(path, start)
    try:
        with path.open("rb") as file:
            state = fold_frames(scan_journal(file, start), start)
            return replace(state, lost=max(os.fstat(file.fileno()).st_size - state.end, 0))
    except (FileNotFoundError, NotADirectoryError):
        return JournalState({}, frozenset(), start)


def read_result(path: StoragePath, entry: JournalEntry) -> SceneResult:
    """Read the result at `entry`; FileNotFoundError if the journal is gone, because its shard was committed."""
    if isinstance(path, UPath):
        return read_object_result(path, entry)
    with path.open("rb") as file:
        file.seek(entry.offset)
        result: SceneResult = decode(file.read(entry.size))
    return result


def find_journal_end(path: StoragePath) -> int:
    """Find where a journal ends, torn frames included [bytes]; 0 if there is none."""
    if isinstance(path, UPath):
        return find_objects_end(path)
    return path.stat().st_size if path.exists() else 0


def find_journals(names: Iterable[str]) -> frozenset[int]:
    """Find the shards whose journals are among the names in `.work/`."""
    return frozenset(int(match[1]) for match in map(_NAME.fullmatch, names) if match)
