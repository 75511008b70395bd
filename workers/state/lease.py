"""Writer lock in an object store: an object that its holder rewrites every few seconds.

It is created by a write that fails if the object exists, and renewed or taken over by writes that fail if it has
changed. Its age is measured by the store's clock; the machines' clocks do not matter. A holder that cannot renew in
time stops well before another process may take the lease, and its pending writes are aborted.
"""

import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Self

from upath import UPath

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import get_store, list_names, make_write_error
from workers.state.lock_owner import decode_owner, describe_owner, encode_owner, explain_refusal, identify_process

if TYPE_CHECKING:
    from tableverse_factory.core.storage.s3 import VersionedObject

LEASE_S = 30.0  # age at which a lease that was not renewed has expired [s]

_HEARTBEAT_S = 5.0
_SAFE_S = LEASE_S - 10.0  # how long a holder trusts its lease after it sent the last renewal that succeeded [s]
_POLL_S = 1.0


class Lease:
    """Lease that a thread renews while the block lasts (see `workers.state.lock.WriterLock`)."""

    def __init__(self, path: UPath, note: Callable[[str], None] | None) -> None:
        self._note = note
        self._path, self._store = path, get_store(path)
        self._token = secrets.token_hex(8)
        self._renewals = 0
        self._etag = ""
        self._sent_at = self._renewed_at = 0.0
        self._lost = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew_until_end, name="lease", daemon=True)

    def __enter__(self) -> Self:
        """Take the lease, at once if it is free, its holder is dead, or it has expired.

        A lease that is not renewed while we look is waited for: its holder may have been killed.
        """
        first: VersionedObject | None = None
        try:
            while not self._create():
                found = self._store.head_and_get(self._path.path)
                if found is None:
                    continue
                if first is not None and found.etag != first.etag:
                    raise BuildError(explain_refusal(self._path.parent.parent, found.data))
                if _is_abandoned(found) and self._replace(found.etag):
                    break
                if first is None and self._note is not None:
                    self._note(f"{self._path}: written {found.age_s:.0f} s ago, free after {LEASE_S:.0f} s: waiting")
                first = found
                time.sleep(_POLL_S)
            self._check_conditional_writes()
        except OSError as error:
            raise make_write_error(self._path, error) from error
        self._store.fence = self._is_safe
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lease, unless it was lost."""
        self._ended.set()
        self._thread.join()
        self._store.fence = None
        if self._is_safe():
            with suppress(OSError):  # if the store does not answer, the lease expires by itself
                self._store.remove(self._path.path)

    def check(self) -> None:
        """Check that the lease is still ours (see `WriterLock`)."""
        if not self._is_safe():
            raise BuildError(
                f"{self._path.parent.parent}: this process has lost the right to write it: the store did not answer "
                f"for {_SAFE_S:.0f} s, or another build took over. Finished scenes are kept: when no other build "
                "of it runs, run the same command to go on"
            )

    def _is_safe(self) -> bool:
        return not self._lost and _read_clock() - self._renewed_at < _SAFE_S

    def _check_conditional_writes(self) -> None:
        """Refuse a store that ignores conditions, where every process would get the lease."""
        if self._store.put_if_absent(self._path.path, b"not to be written") is not None:
            self._store.remove(self._path.path)
            raise BuildError(
                f"{self._path.parent.parent}: this store writes without looking at conditions (If-None-Match), so two "
                "builds could harm each other: give an OUT in another store, or on a disk"
            )

    def _create(self) -> bool:
        return self._accept(self._store.put_if_absent(self._path.path, self._encode()))

    def _replace(self, etag: str) -> bool:
        return self._accept(self._store.put_if_match(self._path.path, self._encode(), etag))

    def _encode(self) -> bytes:
        self._renewals += 1
        self._sent_at = _read_clock()
        return encode_owner(identify_process(), token=self._token, renewals=self._renewals)

    def _accept(self, etag: str | None) -> bool:
        if etag is None:
            return False
        self._etag, self._renewed_at = etag, self._sent_at
        return True

    def _renew_until_end(self) -> None:
        """Renew until the block ends; a store that does not answer is retried until the lease is no longer safe."""
        while not self._ended.wait(_HEARTBEAT_S):
            try:
                if not self._replace(self._etag):
                    self._lost = True
                    return
            except OSError:
                if not self._is_safe():
                    self._lost = True
                    return


def describe_lease(path: UPath) -> str | None:
    """Describe who holds the lease; None if it is free."""
    found = get_store(path).head_and_get(path.path) if path.name in list_names(path.parent) else None
    if found is None or found.age_s > LEASE_S:
        return None
    return describe_owner(found.data)


def _is_abandoned(found: "VersionedObject") -> bool:
    owner = decode_owner(found.data)
    return found.age_s > LEASE_S or (owner is not None and owner.is_dead)


def _read_clock() -> float:
    """Read a clock that also runs while the machine sleeps, as the lease does [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)
