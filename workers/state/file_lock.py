"""The writer's lock on the disk: the kernel drops it with its process, whatever kills it."""

import fcntl
import os
from pathlib import Path
from types import TracebackType
from typing import Self

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import write_error
from workers.state.lock_owner import encode_holder, held_by, this_process


class FileLock:
    """Holds the file `path` locked for as long as the process lives or the block lasts (see `WriterLock`)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1

    def __enter__(self) -> Self:
        try:
            while not self._take():
                pass
        except OSError as error:
            raise write_error(self._path, error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves no trace where no work is in progress; the file goes before the lock does."""
        folder = self._path.parent
        if folder.is_dir() and [path.name for path in folder.iterdir()] == [self._path.name]:
            self._path.unlink()
            folder.rmdir()
        os.close(self._descriptor)

    def check(self) -> None:
        """Nobody can take it away."""

    def _take(self) -> bool:
        """Locks the file; False where its last holder removed it in the meantime (then a new one must be made)."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            same = self._path.exists() and os.path.samestat(os.fstat(descriptor), self._path.stat())
        except BlockingIOError:
            holder = os.read(descriptor, 1000)
            os.close(descriptor)
            raise BuildError(held_by(self._path.parent.parent, holder)) from None
        if not same:
            os.close(descriptor)
            return False
        os.truncate(descriptor, 0)
        os.write(descriptor, encode_holder(this_process()))
        self._descriptor = descriptor
        return True


def holder_of_file(path: Path) -> str | None:
    """Who holds the lock, as a sentence; None where nobody does."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return held_by(path.parent.parent, os.read(descriptor, 1000))
    finally:
        os.close(descriptor)
    return None
