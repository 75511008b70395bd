"""Files on the disk that one process appends to, one per folder, and that all may read.

Many small pieces, each a file, would cost more than they take to make. A killed process never appends again, so only
the end of a file can be torn.
"""

import os
import secrets
from collections import OrderedDict
from pathlib import Path

from tableverse_factory.core.storage.files import make_write_error

_MAX_OPEN = 2


class AppendFiles:
    """The files of this process, the latest few of them open."""

    def __init__(self, suffix: str) -> None:
        """Nothing is created until something is appended; `suffix` ends the names of the files."""
        self._suffix = suffix
        self._open: OrderedDict[Path, tuple[int, str]] = OrderedDict()  # descriptor and name by folder

    def append(self, folder: Path, *pieces: bytes | memoryview) -> tuple[str, int]:
        """Append to this process's file in a folder; returns its name and where the first piece begins.

        BuildError if the disk refuses; the file stays as before.
        """
        try:
            descriptor, name = self._get_file(folder)
            start = os.fstat(descriptor).st_size
            try:
                for piece in pieces:
                    left = memoryview(piece)
                    while left:
                        left = left[os.write(descriptor, left) :]
            except OSError:
                os.ftruncate(descriptor, start)
                raise
        except OSError as error:
            raise make_write_error(folder, error) from error
        return name, start

    def close(self) -> None:
        """Close the files, which stay."""
        for descriptor, _ in self._open.values():
            os.close(descriptor)
        self._open.clear()

    def _get_file(self, folder: Path) -> tuple[int, str]:
        known = self._open.get(folder)
        if known is not None and os.fstat(known[0]).st_nlink == 0:  # its folder was removed
            os.close(self._open.pop(folder)[0])
        if folder not in self._open:
            if len(self._open) >= _MAX_OPEN:
                os.close(self._open.popitem(last=False)[1][0])
            name = secrets.token_hex(8) + self._suffix
            folder.mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
            self._open[folder] = os.open(folder / name, flags, 0o644), name
        self._open.move_to_end(folder)
        return self._open[folder]
