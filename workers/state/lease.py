"""The writer's lock in an object store: an object that its holder writes anew every few seconds.

It is made by a write that fails where there is one already, and renewed and taken over by writes that fail where it
has changed meanwhile. Its age is what the clock of the store says: the clocks of the machines do not matter. A holder
that could not renew its lease in time stops, well before anybody else may take it, and what it still tries to write is
ended.
"""

import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Self

from upath import UPath

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import list_names, store_of, write_error
from workers.state.lock_owner import decode_holder, encode_holder, held_by, this_process

if TYPE_CHECKING:
    from tableverse_factory.core.storage.s3 import VersionedObject

LEASE_S = 30.0
"""Without a renewal for so long, a lease is over."""

_RENEWED_EVERY_S = 5.0
_SAFE_S = LEASE_S - 10.0
"""A holder trusts its lease for so long after it asked for the last renewal that succeeded."""

_LOOKS_EVERY_S = 1.0


class Lease:
    """Held and renewed by a thread while the block lasts (see `workers.state.lock.WriterLock`)."""

    def __init__(self, place: UPath, note: Callable[[str], None] | None) -> None:
        self._note = note
        self._place, self._store = place, store_of(place)
        self._token = secrets.token_hex(8)
        self._renewals = 0
        self._etag = ""
        self._pending = self._asked = 0.0
        self._lost = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="lease", daemon=True)

    def __enter__(self) -> Self:
        """Takes the lease at once where it is free, its holder is dead, or it is over.

        A lease that is not renewed while we look is waited for: its holder may be a driver that was killed.
        """
        first: VersionedObject | None = None
        try:
            while not self._take_free():
                found = self._store.stamped(self._place.path)
                if found is None:
                    continue
                if first is not None and found.etag != first.etag:
                    raise BuildError(held_by(self._place.parent.parent, found.data))
                if self._is_abandoned(found) and self._replace(found.etag):
                    break
                if first is None and self._note is not None:
                    self._note(f"{self._place}: written {found.age_s:.0f} s ago, free after {LEASE_S:.0f} s: waiting")
                first = found
                time.sleep(_LOOKS_EVERY_S)
            self._prove_conditions()
        except OSError as error:
            raise write_error(self._place, error) from error
        self._store.fence = self._is_safe
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Gives the lease back, unless somebody else has it by now."""
        self._ended.set()
        self._thread.join()
        self._store.fence = None
        if self._is_safe():
            with suppress(OSError):  # where the store does not answer, the lease ends by itself
                self._store.remove(self._place.path)

    def check(self) -> None:
        """Says whether the lease is still ours (see `WriterLock`)."""
        if not self._is_safe():
            raise BuildError(
                f"{self._place.parent.parent}: this process has lost the right to write it: the store did not answer "
                f"for {_SAFE_S:.0f} s, or another build took over. Finished scenes are kept: when no other build "
                "of it runs, run the same command to go on"
            )

    def _is_safe(self) -> bool:
        return not self._lost and _now() - self._asked < _SAFE_S

    def _prove_conditions(self) -> None:
        """Refuses a store that ignores conditions: everybody would have the lease there."""
        if self._store.create(self._place.path, b"not to be written") is not None:
            self._store.remove(self._place.path)
            raise BuildError(
                f"{self._place.parent.parent}: this store writes without looking at conditions (If-None-Match), so two "
                "builds could harm each other: give an OUT in another store, or on a disk"
            )

    def _take_free(self) -> bool:
        return self._took(self._store.create(self._place.path, self._content()))

    def _replace(self, etag: str) -> bool:
        return self._took(self._store.replace_if(self._place.path, self._content(), etag))

    def _content(self) -> bytes:
        self._renewals += 1
        self._pending = _now()
        return encode_holder(this_process(), token=self._token, renewals=self._renewals)

    def _took(self, etag: str | None) -> bool:
        if etag is None:
            return False
        self._etag, self._asked = etag, self._pending
        return True

    def _is_abandoned(self, found: "VersionedObject") -> bool:
        holder = decode_holder(found.data)
        return found.age_s > LEASE_S or (holder is not None and holder.is_dead)

    def _keep(self) -> None:
        """Renews until the block ends; a store that does not answer is asked again until the lease is over."""
        while not self._ended.wait(_RENEWED_EVERY_S):
            try:
                if not self._replace(self._etag):
                    self._lost = True
                    return
            except OSError:
                if not self._is_safe():
                    self._lost = True
                    return


def _now() -> float:
    """Seconds that also pass while the machine sleeps: a lease does not sleep."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def holder_of_lease(place: UPath) -> str | None:
    """Who holds the lease, as a sentence; None where nobody does."""
    found = store_of(place).stamped(place.path) if place.name in list_names(place.parent) else None
    if found is None or found.age_s > LEASE_S:
        return None
    return held_by(place.parent.parent, found.data)
