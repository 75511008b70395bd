"""Ctrl-C and SIGTERM: a flag that the driver looks at, and a hard end before three seconds are over."""

import os
import signal
import sys
from types import FrameType, TracebackType

HARD_END_S = 2.5


class StoppedError(Exception):
    """The build was asked to stop; everything finished is safe."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number


class StopSignals:
    """While the block lasts, the first signal sets `number`; if the block is still there 2.5 s later, the process ends.

    Ending hard is safe: results are on the disk when they are recorded, and commits are repaired on the next start.
    """

    def __init__(self, parting_words: str) -> None:
        self.number = 0
        self._parting_words = parting_words
        self._before: dict[int, object] = {}

    def __enter__(self) -> "StopSignals":
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            self._before[number] = signal.getsignal(number)
        self.install()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def install(self) -> None:
        """Takes the signals; again after `ray.init`, which takes SIGTERM for itself."""
        signal.signal(signal.SIGINT, self._stop)
        signal.signal(signal.SIGTERM, self._stop)
        signal.signal(signal.SIGALRM, self._end)

    def check(self) -> None:
        """Raises.

        Raises:
            StoppedError: once a signal has come.
        """
        if self.number:
            raise StoppedError(self.number)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            self._end(number, frame)
        self.number = number
        signal.setitimer(signal.ITIMER_REAL, HARD_END_S)

    def _end(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 the interpreter's signature
        sys.stderr.write(self._parting_words + "\n")
        sys.stderr.flush()
        os._exit(128 + self.number)
