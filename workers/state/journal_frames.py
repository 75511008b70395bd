"""Interface and content of journals: frames, each a finished scene or a scene that must be recomputed.

A `reopen` entry (`failures --retry`) invalidates the scene's earlier results in the journal and in the committed shard.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

from schemas.codec import encode
from schemas.work import SceneResult
from tableverse_factory.core.framing import scan_frames

RESULT, REOPEN = b"+", b"-"  # first byte of a frame's label; the scene id follows


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """Position of a scene's encoded result in its journal [bytes]."""

    offset: int
    size: int
    segment: int = 0  # start of the object that holds it; 0 if the journal is one file


@dataclass(frozen=True, slots=True)
class JournalFrame:
    """A frame as read: a result, or a reopened scene (`entry.size` is 0 then)."""

    kind: bytes
    scene_id: str
    entry: JournalEntry


@dataclass(frozen=True, slots=True)
class JournalState:
    """Content of a journal."""

    results: dict[str, JournalEntry]  # the latest result of each scene
    reopened: frozenset[str]  # scenes that were taken back: each needs a result before its shard can be written
    end: int  # end of the last whole frame [bytes]
    lost: int = 0  # bytes that hold no whole frame: torn by a kill, or damaged on the disk


EMPTY_JOURNAL = JournalState({}, frozenset(), 0)


class Journal(ABC):
    """Journal of one shard, open for appending by one writer.

    Every method raises BuildError if the disk or the store refuses, or another process writes this journal.
    """

    def __init__(self, state: JournalState) -> None:
        self.results, self.reopened = state.results, set(state.reopened)

    def record(self, result: SceneResult) -> None:
        """Append a result; it survives a kill at once on the disk, after about a second in a store."""
        self.results[result.scene_id] = self._append(RESULT, result.scene_id, encode(result))

    def reopen(self, scene_id: str) -> None:
        """Append that a scene must be recomputed; durable once the journal is closed."""
        self._append(REOPEN, scene_id, b"")
        self.results.pop(scene_id, None)
        self.reopened.add(scene_id)

    @abstractmethod
    def read(self, scene_id: str) -> SceneResult:
        """Read the latest result of a scene."""

    @abstractmethod
    def tick(self) -> None:
        """Write results that have waited long enough; called several times a second."""

    @abstractmethod
    def close(self) -> None:
        """Write what waits; the journal stays."""

    @abstractmethod
    def remove(self) -> None:
        """Delete the journal, whose shard is committed."""

    @abstractmethod
    def _append(self, kind: bytes, scene_id: str, payload: bytes) -> JournalEntry:
        """Append a frame and return the position of its payload."""


def scan_journal(stream: BinaryIO, start: int, base: int = 0) -> Iterator[JournalFrame]:
    """Read the whole frames of a file or object up to the first torn one; `base` is where it begins in the journal."""
    for span in scan_frames(stream, start):
        yield JournalFrame(span.label[:1], span.label[1:].decode(), JournalEntry(base + span.offset, span.size, base))


def fold_frames(frames: Iterable[JournalFrame], end: int) -> JournalState:
    """Combine frames that begin at `end` into the state of the journal."""
    results: dict[str, JournalEntry] = {}
    reopened: set[str] = set()
    for frame in frames:
        if frame.kind == RESULT:
            results[frame.scene_id] = frame.entry
        else:
            results.pop(frame.scene_id, None)
            reopened.add(frame.scene_id)
        end = frame.entry.offset + frame.entry.size
    return JournalState(results, frozenset(reopened), end)
