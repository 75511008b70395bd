"""One writer per OUT: on the disk a lock that the kernel drops with its process, in an object store a lease."""

from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from upath import UPath

from tableverse_factory.core.storage.files import StoragePath
from workers.state.file_lock import FileLock, holder_of_file
from workers.state.lease import Lease, holder_of_lease

LOCK = "lock"
"""Its name in the folder of the work."""


class WriterLock(Protocol):
    """Held while the block lasts.

    Raises:
        BuildError: on entry, naming the process that holds it.
    """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def check(self) -> None:
        """Called before anything is written.

        Raises:
            BuildError: if it was lost in the meantime.
        """


def writer_lock(place: StoragePath, note: Callable[[str], None] | None = None) -> WriterLock:
    """The lock at this place, not taken yet.

    Args:
        place: Of the lock.
        note: Told, once, where taking it means to wait.
    """
    return Lease(place, note) if isinstance(place, UPath) else FileLock(place)


def writer_of(place: StoragePath) -> str | None:
    """Who holds the lock at `place`, as a sentence; None where nobody does."""
    return holder_of_lease(place) if isinstance(place, UPath) else holder_of_file(place)
