"""A running build on the screen: a live table on a terminal, a line now and then in a log."""

import time
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tableverse_factory.text import printable

if TYPE_CHECKING:
    from workers.telemetry import Tally

LINE_EVERY_S = 5.0
_DRAW_EVERY_S = 0.25
_MAX_NOTES = 20


class Progress:
    """Shows the tally of a build while the block lasts (a `workers.telemetry.Display`)."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._started = self._shown = time.monotonic()
        self._last_line = ""
        self._notes = 0

    def __enter__(self) -> "Progress":
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def show(self, tally: "Tally") -> None:
        """Draws, if enough time has passed since it last did."""
        now = time.monotonic()
        if now - self._shown < (_DRAW_EVERY_S if self._live else LINE_EVERY_S):
            return
        self._shown = now
        if self._live:
            self._live.update(Group(self._table(tally), Text(self._line(tally))), refresh=True)
            return
        line = self._line(tally)
        if line != self._last_line:
            self._last_line = line
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def note(self, line: str) -> None:
        """Prints a line that a person should read, up to a bound: the dataset has all of them."""
        self._notes += 1
        if self._notes > _MAX_NOTES:
            return
        for part in line.splitlines()[:12]:
            self._console.print(printable(part, 500), highlight=False, markup=False, soft_wrap=True)
        if self._notes == _MAX_NOTES:
            self._console.print("… more of this: see `tableverse failures`", markup=False)

    def _line(self, tally: "Tally") -> str:
        running = ", ".join(f"{stage} {number}" for stage, number in sorted(tally.running.items()))
        return (
            f"{tally.accounted}/{tally.total} scenes, {self._rate(tally)}; in this run {tally.count('done')} done, "
            f"{tally.count('dropped')} dropped, {tally.count('failed')} failed; shards {tally.committed}/{tally.shards}"
            + (f"; running: {running}" if running else "")
            + (f"; workers lost: {tally.losses}" if tally.losses else "")
        )

    def _table(self, tally: "Tally") -> Table:
        table = Table(box=None, pad_edge=False)
        table.add_column("stage")
        for name in ("running", "passed", "dropped", "failed"):
            table.add_column(name, justify="right")
        for stage in tally.stages:
            passed = tally.passed[stage] + tally.ended[stage, "done"]
            counts = (tally.running[stage], passed, tally.ended[stage, "dropped"], tally.ended[stage, "failed"])
            table.add_row(stage, *(str(count) if count else "·" for count in counts))
        return table

    def _rate(self, tally: "Tally") -> str:
        """Scenes per second in this run, and how long the rest will take at that pace."""
        elapsed, ended = time.monotonic() - self._started, tally.accounted - tally.before
        if ended == 0 or elapsed < 1.0:
            return "starting"
        left = (tally.total - tally.accounted) * elapsed / ended
        pace = f"{ended / elapsed:.2f}/s" if ended > elapsed else f"{elapsed / ended:.1f} s each"
        return f"{pace}, about {_duration(left)} left" if left else pace


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
