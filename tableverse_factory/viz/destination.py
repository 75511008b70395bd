"""Destination folders of reports: the default ones, and a gallery's, in which nothing else is written or removed."""

import fcntl
import json
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.apart import require_apart, resolve_links
from tableverse_factory.core.storage.files import PARTIAL, remove, resolve_filesystem, write_atomic
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.core.version import __version__
from tableverse_factory.dataset.dataset import GALLERY_MARKER

LOCK = "drawn/.lock"  # empty; locked by the process that writes the gallery
FOLDERS = ("drawn", "pictures", "scenes")

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
    """Resolve the links of a destination, which is apart from the dataset.

    Raises:
        InputError: as `require_apart`.
    """
    resolve_links(dest)
    if dataset is not None:
        require_apart(dest, dataset)
    return dest.resolve()


@contextmanager
def lock_gallery(folder: Path, dataset: str, name: str) -> Iterator[frozenset[str]]:
    """Make the folders of a gallery, or take those of an earlier one, hold its lock, and yield the files it may have.

    Raises:
        InputError: if the folder is not for this gallery (`check_gallery`), or another process writes it.
    """
    if not (folder / LOCK).is_file():
        check_gallery(folder, dataset, name)  # before the lock is made in somebody's folder
    for part in FOLDERS:
        (folder / part).mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            message = f"{name}: another `tableverse report` writes this gallery: wait for it, or give another --dest"
            raise InputError(message) from None
        yield check_gallery(folder, dataset, name)


def check_gallery(folder: Path, dataset: str, name: str) -> frozenset[str]:
    """Return the files that an earlier gallery may have, by name relative to the folder.

    Raises:
        InputError: unless the folder is absent, empty, or holds nothing but a gallery of this dataset.
    """
    if not folder.exists():
        return frozenset()
    if not folder.is_dir():
        raise InputError(f"{name}: a file; {_ELSE}")
    found = _list_entries(folder)  # before the marker is read, which lists a file before it is written
    marked = (folder / GALLERY_MARKER).is_file()
    files = _read_marker(folder / GALLERY_MARKER, dataset, name) if marked else frozenset()
    own = {GALLERY_MARKER, LOCK, *(f"{part}/" for part in FOLDERS), *files}
    foreign = sorted(entry for entry in found if entry.removesuffix(PARTIAL) not in own)
    if foreign and not marked:
        raise InputError(f"{name}: holds something that is no gallery; {_ELSE}")
    if foreign:
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        raise InputError(f"{name}: holds {foreign[0]!r:.200}{more}, no part of the gallery there: move it, or {_ELSE}")
    return files


def _list_entries(folder: Path) -> list[str]:
    """List everything below a folder by relative name; folders end in a slash. Links are not followed."""
    entries = []
    for base, folders, files in os.walk(folder, onerror=_reraise):
        above = Path(base).relative_to(folder)
        entries += [(above / name).as_posix() for name in files]
        entries += [(above / name).as_posix() + "/" * (not (Path(base) / name).is_symlink()) for name in folders]
    return entries


def _reraise(error: OSError) -> None:
    raise error


def _read_marker(mark: Path, dataset: str, name: str) -> frozenset[str]:
    """Return the files that the marker lists."""
    try:
        known: Any = json.loads(mark.read_text(encoding="utf-8"))
        files, other = frozenset(str(file) for file in known["files"]), str(known["dataset"])
    except (KeyError, TypeError, ValueError, RecursionError):
        raise InputError(
            f"{name}: a gallery whose {GALLERY_MARKER} does not list its files, as of an earlier version: delete it, "
            f"or {_ELSE}"
        ) from None
    if other != dataset:
        shown = sanitize_line(other, 200)
        raise InputError(f"{name}: the gallery of another dataset, {shown}: delete it, or {_ELSE}")
    return files


def write_marker(folder: Path, dataset: str, scenes: int, files: Collection[str]) -> None:
    """Write the marker, which lists the files that the gallery may have."""
    made_by = f"tableverse-factory {__version__}"
    mark = {"made_by": made_by, "dataset": dataset, "scenes": scenes, "files": sorted(files)}
    write_atomic(folder / GALLERY_MARKER, (json.dumps(mark, indent=1) + "\n").encode())


def remove_leftovers(folder: Path, files: Collection[str], keep: Collection[str]) -> None:
    """Remove those of the files that are not kept, and parts of files that a kill left."""
    for entry in _list_entries(folder):
        if entry not in keep and entry.removesuffix(PARTIAL) in files:
            remove(folder / entry)
