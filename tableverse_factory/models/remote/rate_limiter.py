"""Rate limiter for requests to models: limits at a time and per minute, over all processes of one machine.

First come, first served: a request draws a number, holds the lock of its file in the cache folder until it is answered,
and starts when few enough lower numbers are locked. The kernel unlocks the files of a killed process. One small file
holds the time at which the next request may start.
"""

import fcntl
import os
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from schemas.config import AskingConfig
from tableverse_factory.core.errors import ModelAccessError, ModelError

_WAIT_S, _LONGEST_WAIT_S = 0.02, 0.25  # interval between two checks, per request that must end first, and its maximum
_TICKET = "place-"
_NEXT = struct.Struct("<d")


class RateLimiter:
    """Rate limiter with the limits of `asking`, shared by all processes that use the cache folder."""

    def __init__(self, cache_dir: Path, asking: AskingConfig) -> None:
        self._asking = asking
        self._folder = cache_dir / "asking" / _read_boot_id()

    @contextmanager
    def turn(self, deadline: float) -> Iterator[None]:
        """Wait until a request may start, until `deadline` on `time.monotonic` [s]; the block is the request.

        Raises:
            ModelError: if it may not start before the deadline.
            ModelAccessError: if the disk refuses.
        """
        ticket, wait_s = self._acquire(deadline)
        try:
            time.sleep(wait_s)
            yield
        finally:
            os.close(ticket)

    def _acquire(self, deadline: float) -> tuple[int, float]:
        """Return a locked ticket, and how long to wait for the limit per minute [s]."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            number, ticket = self._draw_ticket()
            try:
                self._wait_for(number, deadline)
                return ticket, self._reserve_start(deadline)
            except BaseException:
                os.close(ticket)
                raise
        except OSError as error:
            raise ModelAccessError(
                f"turns to ask cannot be kept in {self._folder}: {error.strerror or error}. Free space, or set "
                "TABLEVERSE_CACHE to another folder"
            ) from error

    def _draw_ticket(self) -> tuple[int, int]:
        """Draw the next number, under a lock; return it and its locked file."""
        draw = os.open(self._folder / "draw", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(draw, fcntl.LOCK_EX)
            number = max(self._list_numbers(), default=0) + 1
            ticket = os.open(self._ticket_path(number), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            fcntl.flock(ticket, fcntl.LOCK_EX)
        finally:
            os.close(draw)
        return number, ticket

    def _wait_for(self, number: int, deadline: float) -> None:
        """Wait until fewer than `max_parallel` requests with lower numbers wait or are under way."""
        while True:
            before = sum(self._is_held(other) for other in self._list_numbers() if other < number)
            if before < self._asking.max_parallel:
                return
            wait = min(_WAIT_S * (before - self._asking.max_parallel + 1), _LONGEST_WAIT_S)
            if time.monotonic() + wait >= deadline:
                raise self._create_timeout_error()
            time.sleep(wait)

    def _list_numbers(self) -> list[int]:
        return [int(path.name.removeprefix(_TICKET)) for path in self._folder.glob(f"{_TICKET}*")]

    def _ticket_path(self, number: int) -> Path:
        return self._folder / f"{_TICKET}{number}"

    def _is_held(self, number: int) -> bool:
        """Whether a ticket is locked by its process; the file of a free one is removed.

        Numbers below ours are not drawn again while we hold ours, so no new ticket is removed.
        """
        try:
            descriptor = os.open(self._ticket_path(number), os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        else:
            self._ticket_path(number).unlink(missing_ok=True)
            return False
        finally:
            os.close(descriptor)

    def _reserve_start(self, deadline: float) -> float:
        """Reserve the next start under the limit per minute; return the wait until then [s].

        Starts are evenly spaced: servers that count by the second refuse sixty at once.
        """
        if not self._asking.per_minute:
            return 0.0
        step = 60.0 / self._asking.per_minute
        descriptor = os.open(self._folder / "next", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            stored = os.pread(descriptor, _NEXT.size, 0)
            now = time.monotonic()  # the same clock for all processes of the machine
            begin = max(now, _NEXT.unpack(stored)[0] if len(stored) == _NEXT.size else now)
            if begin >= deadline:
                raise self._create_timeout_error()
            os.pwrite(descriptor, _NEXT.pack(begin + step), 0)
        finally:
            os.close(descriptor)
        return begin - now

    def _create_timeout_error(self) -> ModelError:
        minute = f" and asking.per_minute {self._asking.per_minute}" if self._asking.per_minute else ""
        return ModelError(
            f"no turn to ask came in time: asking.max_parallel is {self._asking.max_parallel}{minute} on this machine; "
            "raise what the server allows, take fewer workers, or raise the stage's timeout_s"
        )


def _read_boot_id() -> str:
    """Read the id of this machine's boot: machines may share a cache folder, but not a monotonic clock."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
