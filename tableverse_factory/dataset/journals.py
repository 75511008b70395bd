"""Journals of open shards: the result of every scene that ended, until its shard is committed.

A journal is a file of frames on the disk; in a store it is a folder of numbered objects of whole frames, each named by
the offset of its first byte. A reopened scene must be computed again: its earlier results do not count, neither in the
journal nor in the committed shard.
"""

import io
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

from pydantic import TypeAdapter
from upath import UPath

from schemas.codec import decode
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import scan_frames
from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes, read_range, read_whole
from tableverse_factory.core.text import describe_error, sanitize_line
from tableverse_factory.dataset.shards import shard_stem

WORK = ".work"  # folder in OUT of what a build needs until it is complete
SUFFIX = ".journal"
RESULT, REOPEN = b"+", b"-"  # first byte of a frame's label; the scene id follows
_NAME = re.compile(rf"shard-(\d{{5,9}}){re.escape(SUFFIX)}")
_RESULT = TypeAdapter(SceneResult)


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """Position of a scene's encoded result in its journal [bytes]."""

    offset: int
    size: int
    segment: int = 0  # start of the object that holds it; 0 if the journal is one file


@dataclass(frozen=True, slots=True)
class JournalState:
    """Content of a journal."""

    results: dict[str, JournalEntry]  # the latest result of each scene
    reopened: frozenset[str]  # scenes that were taken back: each needs a result before its shard can be written
    end: int  # end of the last whole frame [bytes]
    lost: int = 0  # bytes that hold no whole frame: torn by a kill, or damaged on the disk


EMPTY_JOURNAL = JournalState({}, frozenset(), 0)

_Frame = tuple[bytes, str, JournalEntry]  # kind, scene id, position


def journal_path(out: StoragePath, shard: int) -> StoragePath:
    """Path of the journal of an open shard."""
    return out / WORK / f"{shard_stem(shard)}{SUFFIX}"


def find_journals(names: Iterable[str]) -> frozenset[int]:
    """Find the shards whose journals are among the names in `.work/`."""
    return frozenset(int(match[1]) for match in map(_NAME.fullmatch, names) if match)


def read_journal(path: StoragePath, start: int = 0) -> JournalState:
    """Read a journal from `start` [bytes], 0 or an earlier end, without changing it; a missing one is empty.

    In a store a damaged object loses only its own frames.
    """
    try:
        if isinstance(path, UPath):
            return _read_objects(path, start)
        with path.open("rb") as file:
            state = _fold_frames(_scan_frames(file, start), start)
            return replace(state, lost=max(os.fstat(file.fileno()).st_size - state.end, 0))
    except (FileNotFoundError, NotADirectoryError):  # also if its shard is committed just now
        return replace(EMPTY_JOURNAL, end=start)


def read_result(path: StoragePath, entry: JournalEntry) -> SceneResult:
    """Read the result at `entry`; FileNotFoundError if the journal is gone, because its shard was committed."""
    source = path / segment_name(entry.segment) if isinstance(path, UPath) else path
    return _decode_result(path, read_range(source, entry.offset - entry.segment, entry.size))


def read_results(path: StoragePath) -> dict[str, SceneResult]:
    """Read the latest result of each scene of a journal; none if it is missing, or removed meanwhile."""
    found: dict[str, bytes] = {}
    try:
        for first, data in _read_segments(path):
            for kind, scene_id, entry in _scan_frames(io.BytesIO(data), 0, first):
                found.pop(scene_id, None)
                if kind == RESULT:
                    found[scene_id] = data[entry.offset - first :][: entry.size]
    except FileNotFoundError:
        return {}
    return {scene_id: _decode_result(path, data) for scene_id, data in found.items()}


def find_journal_end(path: StoragePath) -> int:
    """Find where a journal ends, torn frames included [bytes]; 0 if there is none."""
    if isinstance(path, UPath):
        return max((int(name) + size for name, size in list_sizes(path).items()), default=0)
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def segment_name(start: int) -> str:
    """Name of the object of a journal that begins at `start` [bytes]."""
    return f"{start:015d}"


def _decode_result(path: StoragePath, data: bytes) -> SceneResult:
    """Decode and check a result: a dataset from elsewhere may have a journal that no build wrote."""
    try:
        return _RESULT.validate_python(decode(data))
    except ValueError as error:
        why = sanitize_line(describe_error(error))
        raise BuildError(
            f"{path} is no journal of a build ({why}): delete it, and the next run computes its scenes again"
        ) from error


def _read_segments(path: StoragePath, start: int = 0) -> Iterator[tuple[int, bytes]]:
    """Read the objects of a journal that begin at `start` or later, or its one file."""
    if isinstance(path, UPath):
        yield from ((int(name), read_whole(path / name)) for name in list_names(path) if int(name) >= start)
    else:
        yield 0, path.read_bytes()


def _read_objects(folder: UPath, start: int) -> JournalState:
    frames: list[_Frame] = []
    end, lost = start, 0
    for first, data in _read_segments(folder, start):
        whole = list(_scan_frames(io.BytesIO(data), 0, first))
        end = first + len(data)
        lost += end - _fold_frames(whole, first).end
        frames += whole
    return replace(_fold_frames(frames, start), end=end, lost=lost)


def _scan_frames(stream: BinaryIO, start: int, base: int = 0) -> Iterator[_Frame]:
    """Read the whole frames of a file or object up to the first torn one; `base` is where it begins in the journal."""
    for span in scan_frames(stream, start):
        yield span.label[:1], span.label[1:].decode(errors="replace"), JournalEntry(base + span.offset, span.size, base)


def _fold_frames(frames: Iterable[_Frame], end: int) -> JournalState:
    """Combine frames that begin at `end` into the state of the journal."""
    results: dict[str, JournalEntry] = {}
    reopened: set[str] = set()
    for kind, scene_id, entry in frames:
        if kind == RESULT:
            results[scene_id] = entry
        else:
            results.pop(scene_id, None)
            reopened.add(scene_id)
        end = entry.offset + entry.size
    return JournalState(results, frozenset(reopened), end)
