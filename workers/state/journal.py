"""Finished scenes of a shard that is not committed yet: an append-only file, or objects in a store."""

import re
from collections.abc import Iterable

from upath import UPath

from schemas.work import SceneResult
from tableverse_factory.core.storage.files import StoragePath
from workers.state.file_journal import FileJournal, read_file_journal, read_file_result
from workers.state.journal_frames import Journal, JournalEntry, JournalState
from workers.state.object_journal import ObjectJournal, find_objects_end, read_object_journal, read_object_result

SUFFIX = ".journal"
_NAME = re.compile(rf"shard-(\d{{5,9}}){re.escape(SUFFIX)}")


def open_journal(path: StoragePath) -> Journal:
    """Open or create a journal."""
    return ObjectJournal(path) if isinstance(path, UPath) else FileJournal(path)


def read_journal(path: StoragePath, start: int = 0) -> JournalState:
    """Read a journal from `start` [bytes], 0 or an earlier end, without changing it; a missing one is empty."""
    return read_object_journal(path, start) if isinstance(path, UPath) else read_file_journal(path, start)


def read_result(path: StoragePath, entry: JournalEntry) -> SceneResult:
    """Read the result at `entry`; FileNotFoundError if the journal is gone, because its shard was committed."""
    return read_object_result(path, entry) if isinstance(path, UPath) else read_file_result(path, entry)


def find_journal_end(path: StoragePath) -> int:
    """Find where a journal ends, torn frames included [bytes]; 0 if there is none."""
    if isinstance(path, UPath):
        return find_objects_end(path)
    return path.stat().st_size if path.exists() else 0


def find_journals(names: Iterable[str]) -> frozenset[int]:
    """Find the shards whose journals are among the names in `.work/`."""
    return frozenset(int(match[1]) for match in map(_NAME.fullmatch, names) if match)
