"""Destinations apart from a dataset, whose bytes stay as they were built."""

from pathlib import Path

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.core.text import sanitize_line


def require_apart(dest: StoragePath, dataset: StoragePath, may_hold: bool = False) -> None:
    """Require that a destination neither is a dataset nor lies within it, nor holds it.

    Args:
        dest: Destination folder, there or not.
        dataset: Root of the dataset.
        may_hold: Whether the destination may be a folder about the dataset.

    Raises:
        InputError: if it is not apart, also through a link, or if a link leads nowhere.
    """
    root, folder, beside = resolve_links(dataset), resolve_links(dest), resolve_links(dest.parent)
    if folder == root:
        problem = "is"
    elif folder in root.parents:
        problem = "" if may_hold else "holds"
    elif root in folder.parents or root in (beside, *beside.parents):  # a link may lie within it and lead elsewhere
        problem = "lies within"
    else:
        problem = ""
    if not problem:
        return
    led = f", a link to {folder}," if isinstance(dest, Path) and dest.is_symlink() else ""
    shown = sanitize_line(f"DEST {dest}{led} {problem} the dataset, {dataset}", 300)
    raise InputError(f"{shown}: give a folder apart from it, whose bytes stay as they were built")


def resolve_links(path: StoragePath) -> StoragePath:
    """Resolve the links of a local path.

    Raises:
        InputError: if a link leads to itself.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError):
        raise InputError(f"{sanitize_line(str(path), 300)}: a link that leads nowhere; give another folder") from None
