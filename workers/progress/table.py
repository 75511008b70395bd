"""Text of a tally: a table with a row per stage and a few lines below it, or one line."""

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from workers.progress.eta import ProgressRate
from workers.progress.tally import Tally

QUIET_S = 60.0
_EMPTY_CELL = Text("·", style="dim")


def render_table(tally: Tally, rate: ProgressRate, now: float, width: int) -> RenderableType:
    """Render the table and its lines for a terminal of `width` columns."""
    lines = (format_headline(tally, rate, now), _format_outcomes(tally), _format_workers(tally))
    return Group(
        _make_stage_table(tally, rate, now, width), *(Text(line, overflow="ellipsis") for line in lines if line)
    )


def format_headline(tally: Tally, rate: ProgressRate, now: float) -> str:
    """Format the progress, the rate and the remaining time, or what the build waits for."""
    share = f" ({tally.accounted / tally.total:.1%})" if 0 < tally.accounted < tally.total else ""
    return f"{tally.accounted}/{tally.total} scenes{share}, {_format_pace(tally, rate, now)}"


def format_log_line(tally: Tally, rate: ProgressRate, now: float) -> str:
    """Format the tally as one line for a log."""
    begins = format_headline(tally, rate, now)
    under_way = _format_running(tally)
    parts = (begins, _format_outcomes(tally), "" if under_way in begins else under_way)
    return "; ".join(part for part in parts if part)


def _format_pace(tally: Tally, rate: ProgressRate, now: float) -> str:
    if tally.left <= 0:
        return "complete" if tally.accounted >= tally.total else "as many as were asked for"
    quiet_s = rate.idle_s(now)
    if not tally.wall and tally.accounted == tally.before:
        return f"{_format_awaited(tally)}, {format_duration(quiet_s)} so far"
    words = []
    if quiet_s > QUIET_S:
        words.append(f"nothing has ended for {format_duration(quiet_s)}")
    elif per_s := rate.scenes_per_s(now, tally):
        words.append(f"{per_s:.2f}/s" if per_s >= 1.0 else f"{1.0 / per_s:.1f} s each")
    left_s = rate.estimate_left_s(now, tally)
    words.append("too early to say how long" if left_s is None else f"about {format_duration(left_s)} left")
    return ", ".join(words)


def _format_awaited(tally: Tally) -> str:
    """Describe what the build waits for before the first result."""
    if any(tally.running.values()):
        return f"no scene is back yet; {_format_running(tally)}"
    return "waiting for the first worker" if tally.actors else "waiting for the first scene"


def _format_running(tally: Tally) -> str:
    """Format the calls in flight by their first stage."""
    begun = [f"{tally.running[stage]} from {stage}" for stage in tally.stages if tally.running[stage]]
    return f"in work: {', '.join(begun)}" if begun else ""


def _format_outcomes(tally: Tally) -> str:
    ended = ", ".join(f"{tally.count(status)} {status}" for status in ("done", "dropped", "failed"))
    size = f", {format_bytes(tally.bytes_committed)}" if tally.bytes_committed else ""
    run = "in this run " if tally.before else ""
    return f"{run}{ended}; {tally.committed}/{tally.shards} shards{size}"


def _format_workers(tally: Tally) -> str:
    pools = ", ".join(
        f"{pool} {actors.alive}/{actors.target}" for pool, actors in tally.actors.items() if actors.target
    )
    parts = (
        f"workers: {pools}" if pools else "",
        f"{tally.losses} lost" if tally.losses else "",
        f"{tally.restarts} restarted" if tally.restarts else "",
    )
    return "; ".join(part for part in parts if part)


def _make_stage_table(tally: Tally, rate: ProgressRate, now: float, width: int) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("stage", no_wrap=True)
    inside, wide = bool(tally.actors), width >= 76  # unknown from outside the build
    names = (*(("queued", "running") if inside else ()), "done", "dropped", "failed")
    for name in (*names, *(("per s", "median") if wide else ())):
        table.add_column(name, justify="right", no_wrap=True)
    for stage in tally.stages:
        ended = {status: tally.ended[stage, status] for status in ("done", "dropped", "failed")}
        if stage == tally.stages[0] and not ended["dropped"]:
            continue  # the manifest is a stage only where it rejected rows
        cells = [_format_count(tally.queued[stage]), _format_count(tally.running[stage], "bold")] if inside else []
        cells += [
            _format_count(tally.passed[stage] + ended["done"]),
            _format_count(ended["dropped"], "yellow"),
            _format_count(ended["failed"], "red"),
        ]
        if wide:
            per_s = rate.calls_per_s(now, tally, stage)
            median_s = tally.wall[stage].quantile(0.5) if stage in tally.wall else 0.0
            cells += [
                Text(f"{per_s:.2f}") if per_s else _EMPTY_CELL,
                Text(format_seconds(median_s)) if median_s else _EMPTY_CELL,
            ]
        table.add_row(stage, *cells)
    return table


def _format_count(number: int, style: str = "") -> Text:
    return Text(str(number), style=style) if number else _EMPTY_CELL


def format_seconds(value: float) -> str:
    """Format the duration of a call with two significant digits, e.g. `41 ms`, `3.2 s`, `270 s`."""
    if value < 0.1:
        return f"{value * 1000:.1f} ms" if value < 0.01 else f"{value * 1000:.0f} ms"
    return f"{value:.2f} s" if value < 1.0 else f"{value:.1f} s" if value < 10.0 else f"{value:.0f} s"


def format_duration(value: float) -> str:
    """Format a waiting time, e.g. `40 s`, `12 min`, `3.5 h`, `4.2 days`."""
    for unit, length, most in (("s", 1.0, 90.0), ("min", 60.0, 5400.0)):
        if value < most:
            return f"{value / length:.0f} {unit}"
    return f"{value / 3600:.1f} h" if value < 48 * 3600 else f"{value / 86400:.1f} days"


def format_bytes(number: float) -> str:
    """Format bytes in decimal units, e.g. `12.4 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.1f} TB"
