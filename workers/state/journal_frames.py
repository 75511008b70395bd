"""Journal entries as frames: a finished scene, or a scene that must be recomputed.

A `reopen` entry (`failures --retry`) invalidates the scene's earlier results in the journal and in the committed shard.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

from tableverse_factory.core.framing import encode_header, scan_frames

RESULT, REOPEN = b"+", b"-"
"""First byte of a frame's label; the scene id follows."""


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """Position of a scene's encoded result in its journal [bytes].

    Attributes:
        segment: Start of the object that holds it; 0 if the journal is one file.
    """

    offset: int
    size: int
    segment: int = 0


@dataclass(frozen=True, slots=True)
class JournalFrame:
    """A frame as read: a result, or a reopened scene (`entry.size` is 0 then)."""

    kind: bytes
    scene_id: str
    entry: JournalEntry


@dataclass(frozen=True, slots=True)
class JournalState:
    """Content of a journal.

    Attributes:
        results: The latest result of each scene.
        reopened: Scenes that were taken back; each needs a result here before its shard can be written again.
        end: End of the last whole frame [bytes].
        lost: Bytes that hold no whole frame: torn by a kill, or damaged on the disk.
    """

    results: dict[str, JournalEntry]
    reopened: frozenset[str]
    end: int
    lost: int = 0


EMPTY_JOURNAL = JournalState({}, frozenset(), 0)


def encode_entry(kind: bytes, scene_id: str, payload: bytes) -> tuple[bytes, bytes]:
    """Encode a frame in two parts: header with the scene id, and payload."""
    return encode_header(payload, kind + scene_id.encode()), payload


def scan_journal(stream: BinaryIO, start: int, base: int = 0) -> Iterator[JournalFrame]:
    """Read the whole frames of a file or object, up to the first that is torn.

    Args:
        stream: Holds the frames.
        start: Where to begin in the stream [bytes].
        base: Where the stream begins in the journal, which is its `JournalEntry.segment` [bytes].
    """
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
