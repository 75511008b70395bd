"""Output of a process, read in a thread so that the process never blocks."""

import threading
from typing import IO

from tableverse_factory.core.text import sanitize_line

_MAX_LINE = 1 << 16
_END_S = 0.5
_SHOWN = 200


class ProcessOutput:
    """Reader of stdout and stderr that keeps the first line that begins with a brace, and the last line.

    Attributes:
        hello: First line that begins with a brace; empty if there is none yet.
        is_settled: Set when `hello` is known, or the output has ended without one.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self.hello, self.is_settled = b"", threading.Event()
        self._pipe, self._last = pipe, ""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with self._pipe:
            while line := self._pipe.readline(_MAX_LINE):
                if not self.hello and line.startswith(b"{"):
                    self.hello = line
                    self.is_settled.set()
                elif shown := [text for text in line.decode(errors="replace").splitlines() if text.strip()]:
                    self._last = shown[-1]
        self.is_settled.set()

    def read_last_line(self) -> str:
        """Return the last line besides the hello; it is complete when the process has ended."""
        self._thread.join(_END_S)
        return sanitize_line(self._last.strip(), _SHOWN)
