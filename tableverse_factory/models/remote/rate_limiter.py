"""How fast models are asked: at most so many questions at a time and a minute, over all processes of one machine.

First come, first served: a question draws a number, holds its file in the cache folder locked until it is answered, and
begins when few enough with lower numbers are held. The kernel unlocks them with their process, whatever kills it. The
minute is one small file: when the next question may begin.
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

_WAIT_S, _LONGEST_WAIT_S = 0.02, 0.25
"""Between two looks, by how many must end first, and at most [s]: an answer takes seconds."""

_PLACE = "place-"

_NEXT = struct.Struct("<d")


class RateLimiter:
    """The pace of `asking`, for every process that shares the cache folder."""

    def __init__(self, cache_dir: Path, asking: AskingConfig) -> None:
        self._asking = asking
        self._folder = cache_dir / "asking" / _this_boot()

    @contextmanager
    def turn(self, deadline: float) -> Iterator[None]:
        """Waits until a question may begin; it is under way while the block lasts.

        Args:
            deadline: When to give up, on `time.monotonic` [s].

        Raises:
            ModelError: if there is no turn before the deadline.
            ModelAccessError: if the disk refuses.
        """
        place, wait_s = self._take(deadline)
        try:
            time.sleep(wait_s)
            yield
        finally:
            os.close(place)

    def _take(self, deadline: float) -> tuple[int, float]:
        """A place, and how long to wait on it for the minute [s]."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            number, place = self._draw()
            try:
                self._wait_for(number, deadline)
                return place, self._minute(deadline)
            except BaseException:
                os.close(place)
                raise
        except OSError as error:
            raise ModelAccessError(
                f"turns to ask cannot be kept in {self._folder}: {error.strerror or error}. Make room, or name "
                "another folder in TABLEVERSE_CACHE"
            ) from error

    def _draw(self) -> tuple[int, int]:
        """The next number, and its file, locked; numbers are drawn one at a time."""
        draw = os.open(self._folder / "draw", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(draw, fcntl.LOCK_EX)
            number = max(self._numbers(), default=0) + 1
            place = os.open(self._place(number), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            fcntl.flock(place, fcntl.LOCK_EX)
        finally:
            os.close(draw)
        return number, place

    def _wait_for(self, number: int, deadline: float) -> None:
        """Waits until fewer than `max_parallel` questions with lower numbers wait or are under way."""
        while True:
            before = sum(self._is_held(other) for other in self._numbers() if other < number)
            if before < self._asking.max_parallel:
                return
            wait = min(_WAIT_S * (before - self._asking.max_parallel + 1), _LONGEST_WAIT_S)
            if time.monotonic() + wait >= deadline:
                raise self._no_turn()
            time.sleep(wait)

    def _numbers(self) -> list[int]:
        return [int(path.name.removeprefix(_PLACE)) for path in self._folder.glob(f"{_PLACE}*")]

    def _place(self, number: int) -> Path:
        return self._folder / f"{_PLACE}{number}"

    def _is_held(self, number: int) -> bool:
        """Whether whoever drew this number still waits or asks; what is left of the others is removed.

        A number below ours is not drawn again while we are here, so it is never another one's file that is removed.
        """
        try:
            descriptor = os.open(self._place(number), os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        else:
            self._place(number).unlink(missing_ok=True)
            return False
        finally:
            os.close(descriptor)

    def _minute(self, deadline: float) -> float:
        """Seconds until this question may begin; from then on the minute is one question shorter.

        Questions begin evenly: servers that count by the second refuse sixty at once.
        """
        if not self._asking.per_minute:
            return 0.0
        step = 60.0 / self._asking.per_minute
        descriptor = os.open(self._folder / "next", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            kept = os.pread(descriptor, _NEXT.size, 0)
            now = time.monotonic()  # the machine's: all processes read the same
            begin = max(now, _NEXT.unpack(kept)[0] if len(kept) == _NEXT.size else now)
            if begin >= deadline:
                raise self._no_turn()
            os.pwrite(descriptor, _NEXT.pack(begin + step), 0)
        finally:
            os.close(descriptor)
        return begin - now

    def _no_turn(self) -> ModelError:
        minute = f" and asking.per_minute {self._asking.per_minute}" if self._asking.per_minute else ""
        return ModelError(
            f"no turn to ask came in time: asking.max_parallel is {self._asking.max_parallel}{minute} on this machine; "
            "raise what the server allows, take fewer workers, or raise the stage's timeout_s"
        )


def _this_boot() -> str:
    """A name for this machine since it was started: a cache folder may be shared by several, a clock may not."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
