"""Destination folders of reports: the default ones, and the safe replacement of an earlier gallery."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import resolve_filesystem

MARKER = "tableverse-gallery.json"  # file in every gallery that lists its files

_LOCAL = ("file://", "local://")
_ELSE = "give a new or an empty folder"


def choose_destination(out: str, suffix: str) -> Path:
    """Return the default folder of a report: beside the dataset, whose own bytes stay as built."""
    path = Path(out.rstrip("/").rpartition("/")[2]) if "://" in out else Path(out).resolve()
    return path.with_name(f"{path.name}-{suffix}")


def find_local_folder(path: str) -> Path | None:
    """Return the folder of a dataset on the disk; None if it is elsewhere."""
    if "://" in path and not path.startswith(_LOCAL):
        return None
    return Path(os.path.abspath(resolve_filesystem(path)[1]))  # noqa: PTH100 keeps the name of a link, drops `..`


def resolve_destination(dest: Path, dataset: Path | None) -> Path:
    """Resolve the links of a destination that is new, empty or an earlier gallery, and apart from the dataset.

    Raises:
        InputError: if it holds anything else, lies within the dataset, or holds it.
    """
    try:
        folder = dest.resolve()
    except RuntimeError:  # a link that leads to itself
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
    """Raise an `InputError` unless a folder is absent, empty, or holds nothing but a gallery."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(f"{name}: a file; {_ELSE}")
    found = list(_list_entries(folder))
    if not found:
        return
    if not (folder / MARKER).is_file():
        raise InputError(f"{name}: holds something that is no gallery; {_ELSE}")
    own = _read_marker(folder / MARKER, name)
    foreign = [entry for entry in found if entry not in own]
    if foreign:
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        raise InputError(f"{name}: holds {foreign[0]!r:.200}{more}, no part of the gallery there: move it, or {_ELSE}")


def _list_entries(folder: Path) -> Iterator[str]:
    """List everything below a folder by relative name; folders end in a slash. Links are not followed."""
    for base, folders, files in os.walk(folder, onerror=_reraise):
        above = Path(base).relative_to(folder)
        for name in sorted(files):
            yield (above / name).as_posix()
        for name in sorted(folders):
            yield (above / name).as_posix() + ("" if (Path(base) / name).is_symlink() else "/")


def _reraise(error: OSError) -> None:
    raise error


def _read_marker(mark: Path, name: str) -> frozenset[str]:
    """Return the marker itself, the files that it lists, and their folders."""
    try:
        known: Any = json.loads(mark.read_text(encoding="utf-8"))
        files = [str(file) for file in known["files"]]
        folders = [str(folder) for folder in known["folders"]]
    except (KeyError, TypeError, ValueError, RecursionError):
        raise InputError(
            f"{name}: a gallery whose {MARKER} does not list its files, as of an earlier version: delete it, or {_ELSE}"
        ) from None
    return frozenset([MARKER, *files, *folders])


def write_marker(folder: Path, made_by: str, scenes: int) -> None:
    """Write the marker of a finished gallery, which lists its files."""
    entries = sorted(entry for entry in _list_entries(folder) if entry != MARKER)
    mark = {
        "made_by": made_by,
        "scenes": scenes,
        "folders": [entry for entry in entries if entry.endswith("/")],
        "files": [entry for entry in entries if not entry.endswith("/")],
    }
    (folder / MARKER).write_text(json.dumps(mark, indent=1) + "\n", encoding="utf-8")


def replace_folder(new: Path, folder: Path, aside: Path, name: str) -> None:
    """Rename the earlier gallery aside and the finished one to its folder; a kill between the two keeps both.

    All are on one file system. If something was added to the folder meanwhile, it is restored.
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
