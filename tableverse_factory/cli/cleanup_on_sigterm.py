"""Commands that make large things in passing: stopped, they take these away."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def unwind_on_sigterm() -> Iterator[None]:
    """While the block lasts, SIGTERM unwinds it as Ctrl-C does, once; the exit code is 143."""

    def leave(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second one would stop what takes things away
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
