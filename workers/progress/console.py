"""Progress of a build: a live table on a terminal, a line now and then in a log."""

import threading
import time
from typing import IO, Any, Self

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


class OrderedConsole(Console):
    """Console whose prints wait for one another.

    A print beside a live table moves the cursor by the table's height. If two threads do so at once and the height
    changes, the old table stays.
    """

    def __init__(self, *, stderr: bool = False, file: IO[str] | None = None, width: int | None = None) -> None:
        self._order = threading.RLock()
        super().__init__(stderr=stderr, file=file, width=width)

    def __enter__(self) -> Self:
        self._order.acquire()
        super().__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        try:
            super().__exit__(*raised)
        finally:
            self._order.release()


class ProgressDisplay:
    """Progress on the terminal while the block lasts (a `workers.progress.tally.Display`)."""

    def __init__(self, console: OrderedConsole) -> None:
        self._console = console
        # rich takes FORCE_COLOR for a terminal, but a log must not fill with cursor movements
        live = console.is_terminal and not console.is_dumb_terminal and console.file.isatty()
        self._started = self._shown = time.monotonic()
        self._live = Live(_ElapsedTime(self._started), console=console, auto_refresh=False) if live else None
        self._ended = threading.Event()
        self._refreshing: threading.Thread | None = None
        self._rate = ProgressRate()
        self._tally: Tally | None = None
        self._last_line = ""
        self._notes = 0

    def __enter__(self) -> "ProgressDisplay":
        if self._live:
            self._live.start()
            self._refreshing = threading.Thread(target=self._refresh, args=[self._live], daemon=True)
            self._refreshing.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the screen, if there was progress."""
        if self._refreshing:
            self._ended.set()
            self._refreshing.join()
        if self._tally is not None and self._tally.accounted > self._tally.before:
            self._draw(time.monotonic())
        elif self._live:
            self._live.update(Text(""))
        if self._live:
            with self._console:
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
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _refresh(self, live: Live) -> None:
        while not self._ended.wait(_DRAW_EVERY_S):
            with self._console:  # before the lock of `live`, as for every print: the other order would never end
                live.refresh()

    def _render(self, tally: Tally, now: float) -> RenderableType:
        """Render the table if it fits, else one line."""
        width, height = self._console.size
        if height < len(tally.stages) + _LINES_BELOW or width < _MIN_WIDTH:
            return Text(format_headline(tally, self._rate, now))
        return render_table(tally, self._rate, now, width)
