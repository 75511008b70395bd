"""Lock for one writer per OUT: a kernel file lock on the disk, a lease in an object store."""

import fcntl
import os
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Protocol, Self

from upath import UPath

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, make_write_error
from workers.state.lease import Lease, describe_lease
from workers.state.lock_owner import describe_owner, encode_owner, explain_refusal, identify_process

LOCK = "lock"  # its name in the folder of the work
_PATIENCE_S = 0.2  # `describe_writer` takes the lock for a moment, which is no writer [s]


class WriterLock(Protocol):
    """Lock held while the block lasts."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def check(self) -> None:
        """Check the lock before anything is written."""


class FileLock:
    """Lock on a file, held for as long as the process lives or the block lasts (see `WriterLock`)."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1

    def __enter__(self) -> Self:
        try:
            while not self._acquire():
                pass
        except OSError as error:
            raise make_write_error(self._path, error) from error
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the folder of the work if it is empty; the file goes before the lock does."""
        folder = self._path.parent
        try:
            if folder.is_dir() and [path.name for path in folder.iterdir()] == [self._path.name]:
                self._path.unlink()
                with suppress(OSError):  # another command begins in it just now
                    folder.rmdir()
        finally:
            os.close(self._descriptor)

    def check(self) -> None:
        """Do nothing: a kernel lock cannot be lost."""

    def _acquire(self) -> bool:
        """Lock the file; False if its last holder removed it meanwhile, so that a new one must be created."""
        folder = self._path.parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except FileExistsError:  # also if its last holder removed the folder in this moment
            if folder.is_symlink() or folder.is_file() or not folder.parent.is_dir():
                raise
        with ExitStack() as undo:
            try:
                descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
                undo.callback(os.close, descriptor)
                self._lock(descriptor)
                same = os.path.samestat(os.fstat(descriptor), self._path.stat())
            except FileNotFoundError:  # its last holder removed the file or the folder since
                return False
            if same:
                os.truncate(descriptor, 0)
                os.write(descriptor, encode_owner(identify_process()))
                self._descriptor = descriptor
                undo.pop_all()
            return same

    def _lock(self, descriptor: int) -> None:
        until = time.monotonic() + _PATIENCE_S
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() > until:
                    raise BuildError(explain_refusal(self._path.parent.parent, os.read(descriptor, 1000))) from None
                time.sleep(0.01)


def create_writer_lock(path: StoragePath, note: Callable[[str], None] | None = None) -> WriterLock:
    """Create the lock at `path` without taking it; `note` gets one message if taking it means to wait."""
    return Lease(path, note) if isinstance(path, UPath) else FileLock(path)


def describe_writer(path: StoragePath) -> str | None:
    """Describe who holds the lock at `path`, such as `process 4711 on host`; None if it is free."""
    return describe_lease(path) if isinstance(path, UPath) else _describe_file_lock(path)


def _describe_file_lock(path: Path) -> str | None:
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return describe_owner(os.read(descriptor, 1000))
    finally:
        os.close(descriptor)
    return None
