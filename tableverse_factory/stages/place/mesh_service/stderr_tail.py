"""Tail of a process's stderr, read in a thread so that the process never blocks."""

import threading
from typing import IO

from tableverse_factory.core.text import sanitize_line

_BLOCK = 1 << 16
_END_S = 0.5
_SHOWN = 200


class StderrTail:
    """Reader of a process's stderr that keeps the last 64 KiB."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe, self._end = pipe, b""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        while block := self._pipe.read(_BLOCK):
            self._end = (self._end + block)[-_BLOCK:]
        self._pipe.close()

    def read_last_line(self) -> str:
        """Return the last line; it is complete when the process has ended."""
        self._thread.join(_END_S)
        lines = [line for line in self._end.decode(errors="replace").splitlines() if line.strip()]
        return sanitize_line(lines[-1].strip(), _SHOWN) if lines else ""
