"""Captures of a benchmark: one folder that has the files it needs, or a folder of such folders."""

import os
from collections.abc import Iterable
from pathlib import Path

from pydantic import ValidationError

from schemas.identity import check_id, content_hash
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line


def list_captures(folder: Path, *needed: Iterable[str]) -> list[Path]:
    """List the captures that have a file of each group of names: `folder` itself, or those in it, sorted by name."""
    if _has_files(folder, needed):
        return [folder.absolute()]  # `.` has no name
    return sorted(path for path in folder.iterdir() if _has_files(path, needed))


def make_row(kind: SceneKind, path: Path, scene_id: str, known_length: str = "") -> ImageRow:
    """Make the row of a capture or a picture; an `InputError` names a path that is not UTF-8."""
    try:
        return ImageRow(scene_id=scene_id, kind=kind, uri=str(path), known_length=known_length)
    except ValidationError:
        raise InputError(f"{sanitize_line(path.name, 80)}: the name is not UTF-8: rename it") from None


def list_captures_lacking(folder: Path, needed: Iterable[str], missing: Iterable[str]) -> list[Path]:
    """List the captures in `folder` that have a file of `needed` and none of `missing`, sorted by name."""
    return [path for path in list_captures(folder, needed) if find_file(path, missing) is None]


def make_scene_id(capture: Path) -> str:
    """Make the id of a capture's scene: the folder's name, or a hash of it where that cannot be an id."""
    try:
        return check_id(capture.name)
    except ValueError:
        return content_hash(os.fsencode(capture.name))[:12]


def find_file(capture: Path, names: Iterable[str]) -> Path | None:
    """Find the first of these files that a capture has."""
    return next((capture / name for name in names if (capture / name).is_file()), None)


def _has_files(capture: Path, needed: Iterable[Iterable[str]]) -> bool:
    return all(find_file(capture, names) is not None for names in needed)
