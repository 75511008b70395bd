"""Ctrl-C and SIGTERM: a flag that the driver looks at, and a hard end before three seconds are over."""

import os
import signal
import socket
import sys
import threading
from types import FrameType, TracebackType

HARD_END_S = 2.5
_STOPPING = (signal.SIGINT, signal.SIGTERM)


class StoppedError(Exception):
    """The build was asked to stop; everything finished is safe."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number


class StopSignals:
    """While the block lasts, the first signal sets a flag; 2.5 s later, or at the second, the process ends hard.

    A thread keeps the time, because the main thread may sit in native code that lets no Python handler run. Ending
    hard is safe: results are on the disk when they are recorded, and commits are repaired on the next start.
    """

    def __init__(self, parting_words: str) -> None:
        self._number = 0
        self._parting_words = parting_words
        self._before: dict[int, object] = {}
        self._reader, self._writer = socket.socketpair()
        self._previous_descriptor = -1

    def __enter__(self) -> "StopSignals":
        self._before = {number: signal.getsignal(number) for number in _STOPPING}
        self._writer.setblocking(False)
        self._previous_descriptor = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._keep_time, name="stop-signals", daemon=True).start()
        self.install()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.set_wakeup_fd(self._previous_descriptor)
        self._writer.close()
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def install(self) -> None:
        """Takes the signals; again after `ray.init`, which takes SIGTERM for itself."""
        for number in _STOPPING:
            signal.signal(number, self._stop)

    def check(self) -> None:
        """Does nothing, until a signal has come.

        Raises:
            StoppedError: from then on.
        """
        if self._number:
            raise StoppedError(self._number)

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        self._number = number

    def _keep_time(self) -> None:
        """Waits for a signal, then for the block to end, the time to be over, or a second signal."""
        with self._reader:
            number = self._next_signal()
            if number == 0:
                return
            self._reader.settimeout(HARD_END_S)
            try:
                if self._next_signal() == 0:
                    return
            except TimeoutError:
                pass
            cursor = "\x1b[?25h" if sys.stderr.isatty() else ""  # a live table hides it
            sys.stderr.write(f"{cursor}{self._parting_words}\n")
            sys.stderr.flush()
            os._exit(128 + number)

    def _next_signal(self) -> int:
        """The next SIGINT or SIGTERM; 0 where the block has ended."""
        while received := self._reader.recv(1):
            if received[0] in _STOPPING:
                return received[0]
        return 0
