"""Overview figure of a dataset (paper, figure 2), the same bytes for the same dataset."""

import io
import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.ft2font import FT2Font
from matplotlib.ticker import FuncFormatter, MaxNLocator

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.funnel import FunnelStep
from tableverse_factory.viz.overview.dataset_statistics import Histogram, Ranking, Statistics

INK, FAINT, GRID = "#1f2933", "#66727f", "#e4e8ec"
BLUE, TEAL, AMBER, RED, PURPLE = "#2f6db3", "#2a9d8f", "#e0a030", "#c8503c", "#7a5ea8"
SIZE_IN = (15.0, 10.6)
DPI = 110
LABEL_CHARS = 20
MOST_ROWS = 12  # of a panel with horizontal bars

_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": INK,
    "axes.edgecolor": "#c3cad1",
    "axes.labelcolor": FAINT,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "svg.hashsalt": "tableverse",
    "svg.fonttype": "path",
    "text.parse_math": False,
}
_METADATA = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}


def draw_overview(statistics: Statistics, steps: Sequence[FunnelStep], kind: Literal["png", "svg"]) -> bytes:
    """Draw the figure as the bytes of a PNG or SVG file."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        figure = Figure(figsize=SIZE_IN, dpi=DPI, facecolor="white")
        _draw_headline(figure, statistics)
        grid = figure.add_gridspec(3, 3, left=0.105, right=0.985, top=0.86, bottom=0.055, hspace=0.42, wspace=0.44)
        panels: tuple[Callable[[Axes], None], ...] = (
            lambda axes: _draw_funnel(axes, statistics.scenes["entered"], steps),
            lambda axes: _draw_histogram(axes, "Objects per scene", statistics.objects_per_scene, BLUE),
            lambda axes: _draw_histogram(axes, "Quality score", statistics.quality_scores, TEAL),
            lambda axes: _draw_ranking(axes, "Most frequent categories", statistics.labels, BLUE, "objects"),
            lambda axes: _draw_long_tail(axes, statistics),
            lambda axes: _draw_ranking(axes, "Relations asked for", statistics.relations, PURPLE, "tasks"),
            lambda axes: _draw_log_histogram(axes, "Mass of an object", statistics.masses_kg, AMBER, _format_mass),
            lambda axes: _draw_log_histogram(
                axes, "Longest side of an object", statistics.sizes_m, TEAL, _format_length
            ),
            lambda axes: _draw_losses(axes, statistics),
        )
        for index, draw in enumerate(panels):
            draw(figure.add_subplot(grid[index // 3, index % 3]))
        out = io.BytesIO()
        figure.savefig(out, format=kind, metadata=_METADATA[kind])
    # Matplotlib repeats each text in a comment; untrusted text must stay glyph outlines only.
    return re.sub(rb" *<!--.*?-->\n?", b"", out.getvalue(), flags=re.DOTALL) if kind == "svg" else out.getvalue()


def _draw_headline(figure: Figure, statistics: Statistics) -> None:
    scenes, objects = statistics.scenes, statistics.objects
    per_scene = objects["total"] / scenes["done"] if scenes["done"] else 0.0
    numbers = (
        (f"{scenes['done']:,}", "scenes"),
        (f"{objects['total']:,}", "objects"),
        (f"{statistics.labels.names:,}", "categories"),
        (f"{per_scene:.1f}", "objects per scene"),
        (f"{statistics.tasks['accepted']:,}", "tasks"),
        (f"{scenes['usable']:,}", "usable scenes"),
    )
    for index, (number, name) in enumerate(numbers):
        x = 0.105 + 0.15 * index
        figure.text(x, 0.935, number, fontsize=23, fontweight="bold", color=INK)
        figure.text(x, 0.912, name, fontsize=10, color=FAINT)


def _draw_funnel(axes: Axes, entered: int, steps: Sequence[FunnelStep]) -> None:
    axes.set_title("From pictures to scenes")
    names = ["entered", *(step.stage for step in steps)]
    left = np.array([entered, *(step.left for step in steps)])
    dropped = np.array([0, *(step.count_lost("dropped") for step in steps)])
    failed = np.array([0, *(step.count_lost("failed") for step in steps)])
    rows = np.arange(len(names))
    axes.barh(rows, left, color=BLUE, height=0.72)
    axes.barh(rows, dropped, left=left, color=AMBER, height=0.72, label="dropped")
    axes.barh(rows, failed, left=left + dropped, color=RED, height=0.72, label="failed")
    for row, count in enumerate(left.tolist()):
        axes.text(0.01 * max(entered, 1), row, f"{count:,}", va="center", fontsize=7.5, color="white")
    _label_rows(axes, names)
    if entered:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.02, 0.98), ncols=2, frameon=False, fontsize=7.5, handlelength=1.0,
            columnspacing=1.0,
        )  # fmt: skip
    _use_integer_ticks(axes, "x")


def _draw_histogram(axes: Axes, title: str, histogram: Histogram, color: str) -> None:
    axes.set_title(title)
    if _mark_empty(axes, sum(histogram.counts)):
        return
    edges, counts = np.array(histogram.edges), np.array(histogram.counts)
    axes.bar(edges[:-1], counts, width=0.86 * np.diff(edges), align="edge", color=color)
    if edges[1] - edges[0] == 1:
        shown = edges[: -1 : -(-len(counts) // 15)]  # at most 15 ticks, each below the middle of its bar
        axes.set_xticks(shown + 0.43, [f"{value:g}" for value in shown])
    axes.set_ylabel("scenes")
    axes.grid(axis="y", color=GRID)
    _use_integer_ticks(axes, "y")
    middle = np.average(edges[:-1] + (edges[1] - edges[0] - 1) / 2, weights=counts)
    _add_note(axes, f"mean {middle:.1f}")


def _draw_ranking(axes: Axes, title: str, ranking: Ranking, color: str, unit: str) -> None:
    axes.set_title(title)
    if not _mark_empty(axes, ranking.total):
        _draw_rows(axes, ranking.top[:MOST_ROWS], color, unit)


def _draw_rows(axes: Axes, rows: Sequence[tuple[str, int]], color: str | list[str], unit: str) -> None:
    counts = np.array([count for _, count in rows])
    axes.barh(np.arange(len(rows)), counts, color=color, height=0.72)
    for row, count in enumerate(counts):
        axes.text(count + 0.01 * counts.max(), row, f"{count:,}", va="center", fontsize=7.5, color=FAINT)
    axes.set_xlim(0, 1.14 * counts.max())
    _label_rows(axes, [name for name, _ in rows], MOST_ROWS)
    axes.set_xlabel(unit)
    _use_integer_ticks(axes, "x")


def _draw_long_tail(axes: Axes, statistics: Statistics) -> None:
    axes.set_title("Long tail of categories")
    if _mark_empty(axes, len(statistics.long_tail)):
        return
    ranks, counts = np.array(statistics.long_tail, dtype=np.float64).T
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.fill_between(ranks, 0.8, counts, color=BLUE, alpha=0.13, linewidth=0)
    axes.plot(ranks, counts, color=BLUE, linewidth=2, marker="o" if len(ranks) < 30 else None, markersize=3)
    axes.set_xlim(0.9, 1.2 * ranks[-1] + 1)
    axes.set_ylim(0.8, 1.6 * counts[0])
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}" if value >= 1 else ""))
        axis.set_minor_formatter(FuncFormatter(lambda *_: ""))
    axes.set_xlabel("rank of the category")
    axes.set_ylabel("objects")
    axes.grid(color=GRID)
    labels = statistics.labels
    reached = np.cumsum([count for _, count in labels.top]) >= labels.total / 2
    if reached.any():  # the ranking lists enough names
        _add_note(axes, f"{int(np.argmax(reached)) + 1:,} of {labels.names:,} make half")


def _draw_log_histogram(axes: Axes, title: str, histogram: Histogram, color: str, unit: Callable[[float], str]) -> None:
    """Draw bars with logarithmic edges; the first and the last bin include the values beyond them."""
    axes.set_title(title)
    counts = np.array(histogram.counts)
    counts[0] += histogram.below
    counts[-1] += histogram.above
    if _mark_empty(axes, int(counts.sum())):
        return
    places = np.log10(histogram.edges)
    axes.bar(places[:-1], counts, width=0.9 * np.diff(places), align="edge", color=color)
    used = np.flatnonzero(counts)
    axes.set_xlim(places[max(used[0] - 1, 0)], places[min(used[-1] + 2, len(places) - 1)])
    ticks = np.log10([1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0, 3.0, 10.0, 30.0])
    low, high = axes.get_xlim()
    axes.set_xticks(shown := ticks[(ticks >= low) & (ticks <= high)], [unit(10**tick) for tick in shown])
    axes.set_ylabel("objects")
    axes.grid(axis="y", color=GRID)
    _use_integer_ticks(axes, "y")


def _draw_losses(axes: Axes, statistics: Statistics) -> None:
    axes.set_title("Why scenes were lost")
    shown = statistics.losses[:MOST_ROWS]
    if not _mark_empty(axes, len(shown), "none was"):
        colors = [RED if loss.status == "failed" else AMBER for loss in shown]
        _draw_rows(axes, [(f"{loss.stage}: {loss.reason}", loss.count) for loss in shown], colors, "scenes")


def _add_note(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="right", fontsize=8, fontweight="normal", color=FAINT)


def _mark_empty(axes: Axes, count: int, text: str = "nothing yet") -> bool:
    if not count:
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=FAINT)
        axes.set_xticks([])
        axes.set_yticks([])
    return not count


def _label_rows(axes: Axes, names: Sequence[str], least: int = 0) -> None:
    """Label rows from the top; `least` keeps few rows as thin as many."""
    axes.set_yticks(np.arange(len(names)), [sanitize_label(name) for name in names])
    axes.set_ylim(max(len(names), least) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.grid(axis="x", color=GRID)


def sanitize_label(text: str) -> str:
    """Cut untrusted text to one short line; characters that the font lacks become empty boxes."""
    known = _load_glyphs()
    return "".join(c if ord(c) in known else "\u25a1" for c in sanitize_line(text, LABEL_CHARS))


@cache
def _load_glyphs() -> frozenset[int]:
    return frozenset(FT2Font(findfont(FontProperties(family="DejaVu Sans"))).get_charmap())


def _use_integer_ticks(axes: Axes, which: Literal["x", "y"]) -> None:
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _format_count(value)))


def _format_count(value: float) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e4 else f"{value:,.0f}"


def _format_mass(kilograms: float) -> str:
    return f"{kilograms:g} kg" if kilograms >= 0.99 else f"{1000 * kilograms:.3g} g"


def _format_length(metres: float) -> str:
    return f"{metres:g} m" if metres >= 0.99 else f"{100 * metres:.3g} cm"
