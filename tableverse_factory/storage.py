"""Files that are either whole or absent: written under a temporary name, flushed to the disk, renamed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from tableverse_factory.errors import BuildError

_TEMPORARY = ".partial"


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Opens a new file for writing that appears at `path` only when the block ends without an error.

    The parent folder is made where it is missing; an older file at `path` is replaced in one step.

    Raises:
        BuildError: if the disk is full or refuses; nothing is left behind then.
    """
    partial = path.with_name(path.name + _TEMPORARY)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with suppress(OSError):  # it is gone after the rename; the error that counts is the first one
            partial.unlink()


def write_atomic(path: Path, data: bytes) -> None:
    """Writes a small file at once (see `atomic_file`)."""
    with atomic_file(path) as file:
        file.write(data)


def move_into_place(source: Path, target: Path) -> None:
    """Renames a finished file over `target`, on the same file system, durably.

    Raises:
        BuildError: if the file system refuses.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        source.replace(target)
        sync_folder(target.parent)
    except OSError as error:
        raise cannot_write(target, error) from error


def sync_folder(folder: Path) -> None:
    """Makes renames and new names in a folder survive a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def cannot_write(path: Path, error: OSError) -> BuildError:
    """The error that stops a build when its disk does; finished scenes stay safe."""
    return BuildError(
        f"cannot write {path}: {error.strerror or error}. Finished scenes are kept: "
        "make room or fix the permissions, then run the same command to go on"
    )
