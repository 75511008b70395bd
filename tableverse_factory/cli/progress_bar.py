"""Progress of a command: a bar on a terminal, a line now and then in a log; always on stderr."""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from tableverse_factory.core.text import sanitize_line
from workers.progress.console import choose_log_interval_s

if TYPE_CHECKING:
    from rich.progress import Progress

T = TypeVar("T")


class ProgressCounter:
    """Counter of finished items."""

    def __init__(self, what: str, total: int | None, bar: "Progress | None") -> None:
        self._what, self._total, self._bar, self._done = sanitize_line(what, 300), total, bar, 0
        self._task = None if bar is None else bar.add_task(self._what, total=total)
        self._started = self._shown = time.monotonic()
        self._shown_done = 0

    def __call__(self) -> None:
        """Count one more item."""
        self.update(self._done + 1, self._total)

    def update(self, done: int, total: int | None) -> None:
        """Set the number of finished items and their total."""
        self._done, self._total = done, total
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=total)
            return
        now = time.monotonic()
        if now - self._shown >= choose_log_interval_s(now - self._started):
            self._shown = now
            self._print()

    def close(self) -> None:
        """Print the last number behind others in a log."""
        if self._bar is None and 0 < self._shown_done < self._done:
            self._print()

    def _print(self) -> None:
        self._shown_done = self._done
        count = f"{self._done} of {self._total}" if self._total else f"{self._done}"
        print(f"{self._what}: {count}", file=sys.stderr, flush=True)


@contextmanager
def count_progress(what: str, total: int | None = None) -> Iterator[ProgressCounter]:
    """Show the number of finished items, named in the plural, while the block lasts."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    # rich takes FORCE_COLOR for a terminal too, but a log must not fill with cursor movements
    if not (console.is_terminal and sys.stderr.isatty()) or console.is_dumb_terminal:
        counter = ProgressCounter(what, total, None)
        yield counter
        counter.close()
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        yield ProgressCounter(what, total, progress)


def track_progress(what: str, items: Iterable[T], total: int) -> Iterator[T]:
    """Yield the items, `total` of them, and show how many are finished: one is when the next is asked for."""
    with count_progress(what, total) as done:
        for item in items:
            yield item
            done()
