"""Files on the disk that one process appends to, one per folder, and that all may read.

Many small pieces, each a file, would cost more than they take to make. A killed process never appends again, so only
the end of a file can be torn.
"""

import os
import secrets
from collections.abc import Iterable
from pathlib import Path

from tableverse_factory.core.storage.files import make_write_error


class AppendFiles:
    """The files of this process, one in each folder that it appends to."""

    def __init__(self, suffix: str) -> None:
        """Nothing is created until something is appended; `suffix` ends the names of the files."""
        self._name = secrets.token_hex(8) + suffix

    def append(self, folder: Path, *pieces: bytes | memoryview) -> tuple[str, int]:
        """Append to this process's file in a folder; returns its name and where the first piece begins.

        It is closed again, because other machines of a network file system see only what a closed file holds.
        BuildError if the disk refuses; the file stays as before.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder / self._name, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
            try:
                start = os.fstat(descriptor).st_size
                append_whole(descriptor, pieces, start)
            finally:
                os.close(descriptor)
        except OSError as error:
            raise make_write_error(folder, error) from error
        return self._name, start


def append_whole(descriptor: int, pieces: Iterable[bytes | memoryview], start: int) -> None:
    """Append pieces to a file that ends at `start`; if the disk refuses, cut off what it took of them."""
    try:
        for piece in pieces:
            left = memoryview(piece)
            while left:
                left = left[os.write(descriptor, left) :]
    except OSError:
        os.ftruncate(descriptor, start)
        raise
