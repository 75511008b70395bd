"""Progress of a build: a live table on a terminal, a line now and then in a log."""

import threading
import time

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

from tableverse_factory.core.text import sanitize_line
from workers.progress.eta import ProgressRate
from workers.progress.table import format_duration, format_headline, format_log_line, render_table
from workers.progress.tally import Tally

_DRAW_EVERY_S = 0.5
_LOG_INTERVAL_S = (5.0, 300.0)
_LOG_INTERVAL_SHARE = 0.05
MAX_NOTES = 20
_LINES_BELOW = 5
_MIN_WIDTH = 52


def choose_log_interval_s(elapsed_s: float) -> float:
    """Choose the time between two lines of a log [s]: 5 % of the elapsed time, between 5 s and 5 min."""
    least, most = _LOG_INTERVAL_S
    return min(max(least, _LOG_INTERVAL_SHARE * elapsed_s), most)


class _ElapsedTime:
    """Elapsed time, shown before the first count."""

    def __init__(self, started: float) -> None:
        self._started = started

    def __rich__(self) -> Text:
        return Text(f"preparing, {format_duration(time.monotonic() - self._started)}", style="dim")


class ProgressDisplay:
    """Progress on the terminal while the block lasts (a `workers.progress.tally.Display`).

    rich's own refreshing thread moves the cursor by the height of a table that a line printed at the same time has not
    written yet, and two tables stay. So one lock orders all that is drawn.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        # rich takes FORCE_COLOR for a terminal, but a log must not fill with cursor movements
        live = console.is_terminal and not console.is_dumb_terminal and console.file.isatty()
        self._started = self._shown = time.monotonic()
        self._live = Live(_ElapsedTime(self._started), console=console, auto_refresh=False) if live else None
        self._drawing = threading.Lock()
        self._ended = threading.Event()
        self._refreshing = threading.Thread(target=self._refresh, name="progress display", daemon=True)
        self._rate = ProgressRate()
        self._tally: Tally | None = None
        self._last_line = ""
        self._notes = 0

    def __enter__(self) -> "ProgressDisplay":
        if self._live:
            self._live.start()
            self._refreshing.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the screen, if there was progress."""
        if self._live:
            self._ended.set()
            self._refreshing.join()
        if self._tally is not None and self._tally.accounted > self._tally.before:
            self._draw(time.monotonic())
        elif self._live:
            self._live.update(Text(""))
        if self._live:
            self._live.stop()

    def show(self, tally: Tally) -> None:
        """Draw, if enough time has passed since the last time."""
        now = time.monotonic()
        self._tally = tally
        self._rate.update(now, tally)
        if now - self._shown >= (_DRAW_EVERY_S if self._live else choose_log_interval_s(now - self._started)):
            self._draw(now)

    def note(self, line: str) -> None:
        """Print a line, up to a bound: the dataset has all failures."""
        self._notes += 1
        if self._notes > MAX_NOTES:
            return
        for part in line.splitlines()[:12]:
            self._print(sanitize_line(part, 500))
        if self._notes == MAX_NOTES:
            self._print("… more of this: see `tableverse failures`")

    def _draw(self, now: float) -> None:
        if self._tally is None:
            return
        self._shown = now
        if self._live:
            self._live.update(self._render(self._tally, now))
            return
        line = format_log_line(self._tally, self._rate, now)
        if line != self._last_line:
            self._last_line = line
            self._print(line)

    def _print(self, line: str) -> None:
        with self._drawing:
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _refresh(self) -> None:
        while self._live and not self._ended.wait(_DRAW_EVERY_S):
            with self._drawing:
                self._live.refresh()

    def _render(self, tally: Tally, now: float) -> RenderableType:
        """Render the table if it fits, else one line."""
        width, height = self._console.size
        if height < len(tally.stages) + _LINES_BELOW or width < _MIN_WIDTH:
            return Text(format_headline(tally, self._rate, now))
        return render_table(tally, self._rate, now, width)
