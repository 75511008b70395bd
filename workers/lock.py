"""One writer per OUT: a lock that the kernel drops with its process, whatever kills it."""

import fcntl
import json
import os
import platform
from pathlib import Path
from types import TracebackType

from tableverse_factory.errors import BuildError
from tableverse_factory.storage import cannot_write


class WriterLock:
    """Holds `path` locked for as long as the process lives or the block lasts.

    Raises:
        BuildError: on entry, naming the process that holds the lock.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1

    def __enter__(self) -> "WriterLock":
        try:
            while not self._take():
                pass
        except OSError as error:
            raise cannot_write(self._path, error) from error
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
            raise BuildError(_message(self._path.parent.parent, holder)) from None
        if not same:
            os.close(descriptor)
            return False
        os.truncate(descriptor, 0)
        os.write(descriptor, json.dumps({"pid": os.getpid(), "host": platform.node()}).encode())
        self._descriptor = descriptor
        return True


def writer_of(path: Path) -> str | None:
    """Who holds the lock at `path`, as a sentence; None where nobody does."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _message(path.parent.parent, os.read(descriptor, 1000))
    finally:
        os.close(descriptor)
    return None


def _message(out: Path, holder: bytes) -> str:
    try:
        who = json.loads(holder)
        pid, host = int(who["pid"]), str(who["host"])
    except (ValueError, KeyError, TypeError):
        return f"{out} is being written by another process: wait for it, or stop it and run this again"
    how = f" (kill {pid})" if host == platform.node() else ""
    return f"{out} is being written by process {pid} on {host}: wait for it, or stop it{how} and run this again"
