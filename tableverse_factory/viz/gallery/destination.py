"""The folder of a gallery: what may be replaced by a new one, and how, so that nothing of anybody's is lost."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import filesystem_at

MARK = "tableverse-gallery.json"
"""Lies in every gallery, and lists its files."""

_LOCAL = ("file://", "local://")
_ELSE = "give a new or an empty folder"


def folder_of(path: str) -> Path | None:
    """Where a dataset lies on the disk; None where it lies elsewhere."""
    if "://" in path and not path.startswith(_LOCAL):
        return None
    return Path(os.path.abspath(filesystem_at(path)[1]))  # noqa: PTH100 keeps the name of a link, drops `..`


def checked_dest(dest: Path, dataset: Path | None) -> Path:
    """The folder itself, where `dest` is a link to it.

    Args:
        dest: May be new, empty, or an earlier gallery.
        dataset: Its folder, on the disk.

    Raises:
        InputError: if it holds anything but an earlier gallery, lies within the dataset, or holds it.
    """
    try:
        folder = dest.resolve()
    except RuntimeError:  # Python's word for a link that leads to itself
        raise InputError(f"{dest}: a link that leads nowhere; {_ELSE}") from None
    if dataset is not None:
        root = dataset.resolve()
        if root == folder or root in folder.parents:
            raise InputError(f"{dest}: lies within the dataset, whose bytes stay as built; give another folder")
        if folder in root.parents:
            raise InputError(f"{dest}: the dataset lies within it; give a folder that the gallery has for itself")
    if folder.is_mount():
        raise InputError(f"{dest}: a file system of its own, which cannot be replaced; give a folder within it")
    check_replaceable(folder, str(dest))
    return folder


def check_replaceable(folder: Path, name: str) -> None:
    """Whether all that lies in a folder was put there by a gallery.

    Args:
        folder: May be absent.
        name: For errors.

    Raises:
        InputError: if it is a file, or something in it is no part of the gallery there.
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(f"{name}: a file; {_ELSE}")
    found = list(_entries(folder))
    if not found:
        return
    if not (folder / MARK).is_file():
        raise InputError(f"{name}: holds something that is no gallery; {_ELSE}")
    own = _listed(folder / MARK, name)
    foreign = [entry for entry in found if entry not in own]
    if foreign:
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        raise InputError(f"{name}: holds {foreign[0]!r:.200}{more}, no part of the gallery there: move it, or {_ELSE}")


def _entries(folder: Path) -> Iterator[str]:
    """Whatever lies below, by name; folders end in a slash. Links are not followed.

    Raises:
        OSError: if a folder cannot be looked into.
    """
    for base, folders, files in os.walk(folder, onerror=_raised):
        above = Path(base).relative_to(folder)
        for name in sorted(files):
            yield (above / name).as_posix()
        for name in sorted(folders):
            yield (above / name).as_posix() + ("" if (Path(base) / name).is_symlink() else "/")


def _raised(error: OSError) -> None:
    raise error


def _listed(mark: Path, name: str) -> frozenset[str]:
    """The mark itself, the files that it lists, and their folders."""
    try:
        known: Any = json.loads(mark.read_text(encoding="utf-8"))
        files = [str(file) for file in known["files"]]
        folders = [str(folder) for folder in known["folders"]]
    except (KeyError, TypeError, ValueError, RecursionError):
        raise InputError(
            f"{name}: a gallery whose {MARK} does not list its files, as of an earlier version: delete it, or {_ELSE}"
        ) from None
    return frozenset([MARK, *files, *folders])


def write_mark(folder: Path, made_by: str, scenes: int) -> None:
    """Lists all that lies in a finished gallery."""
    entries = sorted(entry for entry in _entries(folder) if entry != MARK)
    mark = {
        "made_by": made_by,
        "scenes": scenes,
        "folders": [entry for entry in entries if entry.endswith("/")],
        "files": [entry for entry in entries if not entry.endswith("/")],
    }
    (folder / MARK).write_text(json.dumps(mark, indent=1) + "\n", encoding="utf-8")


def put_in_place(new: Path, folder: Path, aside: Path, name: str) -> None:
    """Renames what was there aside, and the finished gallery to its folder. A kill between the two leaves both.

    Args:
        new: Beside `folder`, on the same file system.
        folder: As `checked_dest` gave it.
        aside: Absent, on the same file system.
        name: Of the folder, for errors.

    Raises:
        InputError: if somebody has put something into the folder meanwhile; it is back in its place then.
    """
    if not folder.exists():
        new.rename(folder)
        return
    try:
        folder.rename(aside)
        check_replaceable(aside, name)
        new.rename(folder)
    except BaseException:
        if aside.exists() and not folder.exists():
            aside.rename(folder)
        raise
