"""Handling of Ctrl-C and SIGTERM: a flag that the driver checks, and a hard exit before three seconds are over."""

import os
import signal
import socket
import sys
import threading
from types import FrameType

HARD_END_S = 2.5
STOPPED_MESSAGE = "stopped; everything finished is kept: run the same command to go on"
_STOPPING = (signal.SIGINT, signal.SIGTERM)


class StoppedError(Exception):
    """The build was asked to stop; everything finished is safe."""

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.number = number


class StopSignals:
    """Signal handlers of a block: the first signal sets a flag; 2.5 s later, or at a second signal, the process exits.

    A thread keeps the time, because the main thread may run native code that lets no Python handler run. The hard exit
    is safe: results are on the disk when they are recorded, and commits are repaired on the next start.
    """

    def __init__(self, message: str = STOPPED_MESSAGE) -> None:
        """Take the `message` that is printed at a hard exit."""
        self._number = 0
        self._message = message
        self._before: dict[int, object] = {}
        self._reader, self._writer = socket.socketpair()
        self._previous_descriptor = -1

    def __enter__(self) -> "StopSignals":
        self._before = {number: signal.getsignal(number) for number in _STOPPING}
        self._writer.setblocking(False)
        self._previous_descriptor = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._watch_signals, name="stop-signals", daemon=True).start()
        self.install()
        return self

    def __exit__(self, *_: object) -> None:
        signal.set_wakeup_fd(self._previous_descriptor)
        self._writer.close()
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def install(self) -> None:
        """Install the handlers; needed again after `ray.init`, which takes SIGTERM for itself."""
        for number in _STOPPING:
            signal.signal(number, self._stop)

    def check(self) -> None:
        """Raise if a signal has come."""
        if self._number:
            raise StoppedError(self._number)

    def _stop(self, number: int, _frame: FrameType | None) -> None:
        self._number = number

    def _watch_signals(self) -> None:
        """Wait for a signal, then for the end of the block, the timeout, or a second signal."""
        with self._reader:
            number = self._receive_signal()
            if number == 0:
                return
            self._reader.settimeout(HARD_END_S)
            try:
                if self._receive_signal() == 0:
                    return
            except TimeoutError:
                pass
            cursor = "\x1b[?25h" if sys.stderr.isatty() else ""  # a live table hides it
            sys.stderr.write(f"{cursor}{self._message}\n")
            sys.stderr.flush()
            os._exit(128 + number)

    def _receive_signal(self) -> int:
        """Return the next SIGINT or SIGTERM; 0 when the block has ended."""
        while received := self._reader.recv(1):
            if received[0] in _STOPPING:
                return received[0]
        return 0
