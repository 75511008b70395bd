"""Finished scenes of a shard that is not committed yet, wherever OUT is: a file that grows, or objects of a store."""

import re
from collections.abc import Iterable
from typing import Protocol

from upath import UPath

from schemas.work import SceneResult
from tableverse_factory.core.storage.files import StoragePath
from workers.state.file_journal import FileJournal, end_of_file, read_file, read_from_file
from workers.state.journal_frames import JournalEntry, JournalState
from workers.state.object_journal import SegmentJournal, end_of_segments, read_from_segment, read_segments

_NAME = re.compile(r"shard-(\d{5,9})\.journal")


class Journal(Protocol):
    """The journal of one shard, open for adding, with one writer.

    Attributes:
        results: The latest result of each scene.
        reopened: Scenes that were taken back.
    """

    results: dict[str, JournalEntry]
    reopened: set[str]

    def record(self, result: SceneResult) -> None:
        """Adds a result; it is safe from kills now, or in a store about a second later."""

    def reopen(self, scene_id: str) -> None:
        """Adds that a scene is to be computed again; safe when the journal is closed."""

    def read(self, scene_id: str) -> SceneResult:
        """The latest result of a scene."""

    def tick(self) -> None:
        """Called several times a second: writes what has waited long enough."""

    def close(self) -> None:
        """Writes what waits; the journal stays."""

    def remove(self) -> None:
        """Removes it: its shard is committed."""


def open_journal(place: StoragePath) -> Journal:
    """Opens or starts a journal.

    Raises:
        BuildError: if the disk or the store refuses.
    """
    return SegmentJournal(place) if isinstance(place, UPath) else FileJournal(place)


def read_contents(place: StoragePath, start: int = 0) -> JournalState:
    """What a journal says, without changing it; a missing one says nothing.

    Args:
        place: Of the journal.
        start: Where to begin: 0, or the `end` of an earlier look [bytes].
    """
    return read_segments(place, start) if isinstance(place, UPath) else read_file(place, start)


def read_result(place: StoragePath, entry: JournalEntry) -> SceneResult:
    """The result that stands at `entry`.

    Raises:
        FileNotFoundError: if the journal is gone: its shard was committed.
    """
    return read_from_segment(place, entry) if isinstance(place, UPath) else read_from_file(place, entry)


def journal_end(place: StoragePath) -> int:
    """Where a journal ends, torn frames included [bytes]; 0 where there is none."""
    return end_of_segments(place) if isinstance(place, UPath) else end_of_file(place)


def journal_place(work: StoragePath, shard: int) -> StoragePath:
    """Where the results of an open shard are kept."""
    return work / f"shard-{shard:05d}.journal"


def journals_among(names: Iterable[str]) -> frozenset[int]:
    """Numbers of the shards whose journals are among the names in the folder of the work."""
    return frozenset(int(match[1]) for match in map(_NAME.fullmatch, names) if match)
