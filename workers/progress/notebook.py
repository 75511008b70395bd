"""Progress of a build in a Jupyter notebook, and the choice of a display for the place where a build was called."""

import io
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from html import escape
from importlib import import_module
from typing import Any, Literal

from rich.console import Console, RenderableType
from rich.text import Text

from tableverse_factory.core.text import sanitize_line
from workers.progress.console import MAX_NOTES, OrderedConsole, ProgressDisplay
from workers.progress.eta import ProgressRate
from workers.progress.table import render_table
from workers.progress.tally import Display, DisplayGroup, Tally

_DRAW_EVERY_S = 1.0
_WIDTH = 100


class NotebookDisplay:
    """A table of the stages in the output of a cell (a `workers.progress.tally.Display`)."""

    def __init__(self, publish: Callable[..., Any] | None = None) -> None:
        """Take `publish` in place of `IPython.display.display`."""
        self._publish = publish or import_module("IPython.display").display
        self._rate = ProgressRate()
        self._tally: Tally | None = None
        self._drawn = 0.0
        self._notes = 0
        self._handle: Any = None

    def __enter__(self) -> "NotebookDisplay":
        self._handle = self._publish(_to_mime(Text("preparing …")), raw=True, display_id=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._tally is not None:
            self._draw(self._tally, time.monotonic())

    def show(self, tally: Tally) -> None:
        """Redraw the table, at most once a second."""
        now = time.monotonic()
        self._tally = tally
        self._rate.update(now, tally)
        if now - self._drawn >= _DRAW_EVERY_S:
            self._draw(tally, now)

    def note(self, line: str) -> None:
        """Print a line below the table, up to a bound."""
        self._notes += 1
        if self._notes <= MAX_NOTES:
            self._publish(_to_mime(Text(sanitize_line(line, 500))), raw=True)

    def _draw(self, tally: Tally, now: float) -> None:
        self._drawn = now
        self._handle.update(_to_mime(render_table(tally, self._rate, now, _WIDTH)), raw=True)


def open_display(display: Display | Literal["auto"] | None) -> AbstractContextManager[Display]:
    """Open the display for a build: a given one, none, or the one that suits a notebook, terminal or log."""
    if display is None:
        return nullcontext(DisplayGroup())
    if display != "auto":
        return display if isinstance(display, AbstractContextManager) else nullcontext(display)
    return NotebookDisplay() if _is_notebook() else ProgressDisplay(OrderedConsole(stderr=True))


def _is_notebook() -> bool:
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    return hasattr(shell, "kernel")


def _to_mime(renderable: RenderableType) -> dict[str, str]:
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None)
    with console.capture() as capture:
        console.print(renderable)
    text = capture.get()
    return {"text/plain": text, "text/html": f"<pre>{escape(text)}</pre>"}
