"""A running build on the screen: a live table on a terminal, a line now and then in a log."""

import time
from types import TracebackType

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

from tableverse_factory.cli.progress_bar import choose_log_interval_s
from tableverse_factory.core.text import sanitize_line
from workers.progress.eta import ProgressRate
from workers.progress.table import format_duration, format_headline, format_log_line, render_table
from workers.progress.tally import Tally

_DRAW_EVERY_S = 0.5
MAX_NOTES = 20
_LINES_BELOW = 5
_MIN_WIDTH = 52


class _ElapsedTime:
    """What is seen before there is anything to count, so that a cold start of Ray does not look like a hang."""

    def __init__(self, started: float) -> None:
        self._started = started

    def __rich__(self) -> Text:
        return Text(f"preparing, {format_duration(time.monotonic() - self._started)}", style="dim")


class ProgressDisplay:
    """Shows the tally of a build while the block lasts (a `workers.progress.tally.Display`)."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # rich takes FORCE_COLOR for a terminal too, but a log of a pipeline must not fill with cursor movements
        live = console.is_terminal and not console.is_dumb_terminal and console.file.isatty()
        self._started = self._shown = time.monotonic()
        self._live = Live(_ElapsedTime(self._started), console=console, refresh_per_second=2) if live else None
        self._pace = ProgressRate()
        self._tally: Tally | None = None
        self._last_line = ""
        self._notes = 0

    def __enter__(self) -> "ProgressDisplay":
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves the last state standing, if there was anything to see."""
        if self._tally is not None and self._tally.accounted > self._tally.before:
            self._draw(time.monotonic())
        elif self._live:
            self._live.update(Text(""))
        if self._live:
            self._live.stop()

    def show(self, tally: Tally) -> None:
        """Draws, if enough time has passed since it last did."""
        now = time.monotonic()
        self._tally = tally
        self._pace.update(now, tally)
        if now - self._shown >= (_DRAW_EVERY_S if self._live else choose_log_interval_s(now - self._started)):
            self._draw(now)

    def note(self, line: str) -> None:
        """Prints a line that a person should read, up to a bound: the dataset has all of them."""
        self._notes += 1
        if self._notes > MAX_NOTES:
            return
        for part in line.splitlines()[:12]:
            self._console.print(sanitize_line(part, 500), highlight=False, markup=False, soft_wrap=True)
        if self._notes == MAX_NOTES:
            self._console.print("… more of this: see `tableverse failures`", markup=False)

    def _draw(self, now: float) -> None:
        if self._tally is None:
            return
        self._shown = now
        if self._live:
            self._live.update(self._picture(self._tally, now))
            return
        line = format_log_line(self._tally, self._pace, now)
        if line != self._last_line:
            self._last_line = line
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _picture(self, tally: Tally, now: float) -> RenderableType:
        """The table where it fits, else the line that matters most."""
        width, height = self._console.size
        if height < len(tally.stages) + _LINES_BELOW or width < _MIN_WIDTH:
            return Text(format_headline(tally, self._pace, now))
        return render_table(tally, self._pace, now, width)
