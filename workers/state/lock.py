"""Lock for one writer per OUT: a kernel file lock on the disk, a lease in an object store."""

from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from upath import UPath

from tableverse_factory.core.storage.files import StoragePath
from workers.state.file_lock import FileLock, describe_file_lock
from workers.state.lease import Lease, describe_lease

LOCK = "lock"  # its name in the folder of the work


class WriterLock(Protocol):
    """Lock held while the block lasts."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def check(self) -> None:
        """Check the lock before anything is written."""


def create_writer_lock(path: StoragePath, note: Callable[[str], None] | None = None) -> WriterLock:
    """Create the lock at `path` without taking it; `note` gets one message if taking it means to wait."""
    return Lease(path, note) if isinstance(path, UPath) else FileLock(path)


def describe_writer(path: StoragePath) -> str | None:
    """Describe who holds the lock at `path`; None if it is free."""
    return describe_lease(path) if isinstance(path, UPath) else describe_file_lock(path)
