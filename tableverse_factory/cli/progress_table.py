"""What is shown of a tally: a table with a row per stage and a few lines below it, or all of it in one line."""

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from workers.progress.eta import ProgressRate
from workers.progress.tally import Tally

QUIET_S = 60.0
_NOTHING = Text("·", style="dim")


def board(tally: Tally, pace: ProgressRate, now: float, width: int) -> RenderableType:
    """The table and its lines, for a terminal `width` columns wide."""
    lines = (headline(tally, pace, now), _this_run(tally), _workers(tally))
    return Group(_table(tally, pace, now, width), *(Text(line, overflow="ellipsis") for line in lines if line))


def headline(tally: Tally, pace: ProgressRate, now: float) -> str:
    """How far it is, how fast it goes, and when it will end, or what it waits for."""
    share = f" ({tally.accounted / tally.total:.1%})" if 0 < tally.accounted < tally.total else ""
    return f"{tally.accounted}/{tally.total} scenes{share}, {_pace(tally, pace, now)}"


def one_line(tally: Tally, pace: ProgressRate, now: float) -> str:
    """Everything in a line, for a log."""
    begins = headline(tally, pace, now)
    under_way = _under_way(tally)
    parts = (begins, _this_run(tally), "" if under_way in begins else under_way)
    return "; ".join(part for part in parts if part)


def _pace(tally: Tally, pace: ProgressRate, now: float) -> str:
    if tally.left <= 0:
        return "complete" if tally.accounted >= tally.total else "as many as were asked for"
    quiet_s = pace.quiet_s(now)
    if not tally.wall and tally.accounted == tally.before:
        return f"{_awaited(tally)}, {duration(quiet_s)} so far"
    words = []
    if quiet_s > QUIET_S:
        words.append(f"nothing has ended for {duration(quiet_s)}")
    elif rate := pace.scenes_per_s(now, tally):
        words.append(f"{rate:.2f}/s" if rate >= 1.0 else f"{1.0 / rate:.1f} s each")
    left_s = pace.left_s(now, tally)
    words.append("too early to say how long" if left_s is None else f"about {duration(left_s)} left")
    return ", ".join(words)


def _awaited(tally: Tally) -> str:
    """What there is to wait for before anything has come back, in words."""
    if any(tally.running.values()):
        return f"no scene is back yet; {_under_way(tally)}"
    return "waiting for the first worker" if tally.actors else "waiting for the first scene"


def _under_way(tally: Tally) -> str:
    """Calls by the stage that each began with; how far along its stages a call is, only its worker knows."""
    begun = [f"{stage} {tally.running[stage]}" for stage in tally.stages if tally.running[stage]]
    return f"running from {', '.join(begun)}" if begun else ""


def _this_run(tally: Tally) -> str:
    ended = ", ".join(f"{tally.count(status)} {status}" for status in ("done", "dropped", "failed"))
    size = f", {bytes_as_text(tally.bytes_committed)}" if tally.bytes_committed else ""
    run = "in this run " if tally.before else ""
    return f"{run}{ended}; {tally.committed}/{tally.shards} shards{size}"


def _workers(tally: Tally) -> str:
    pools = ", ".join(
        f"{pool} {actors.alive}/{actors.target}" for pool, actors in tally.actors.items() if actors.target
    )
    parts = (
        f"workers: {pools}" if pools else "",
        f"{tally.losses} lost" if tally.losses else "",
        f"{tally.restarts} restarted" if tally.restarts else "",
    )
    return "; ".join(part for part in parts if part)


def _table(tally: Tally, pace: ProgressRate, now: float, width: int) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("stage", no_wrap=True)
    inside, wide = bool(tally.actors), width >= 76  # who looks from outside does not know what waits and what runs
    names = (*(("queued", "running") if inside else ()), "done", "dropped", "failed")
    for name in (*names, *(("per s", "median") if wide else ())):
        table.add_column(name, justify="right", no_wrap=True)
    for stage in tally.stages:
        ended = {status: tally.ended[stage, status] for status in ("done", "dropped", "failed")}
        if stage == tally.stages[0] and not ended["dropped"]:
            continue  # the manifest is a stage only where it rejected rows
        cells = [_count(tally.queued[stage]), _count(tally.running[stage], "bold")] if inside else []
        cells += [
            _count(tally.passed[stage] + ended["done"]),
            _count(ended["dropped"], "yellow"),
            _count(ended["failed"], "red"),
        ]
        if wide:
            rate = pace.calls_per_s(now, tally, stage)
            median_s = tally.wall[stage].quantile(0.5) if stage in tally.wall else 0.0
            cells += [Text(f"{rate:.2f}") if rate else _NOTHING, Text(seconds(median_s)) if median_s else _NOTHING]
        table.add_row(stage, *cells)
    return table


def _count(number: int, style: str = "") -> Text:
    return Text(str(number), style=style) if number else _NOTHING


def seconds(value: float) -> str:
    """A duration of a call with two digits that matter, e.g. `41 ms`, `3.2 s`, `270 s`."""
    if value < 0.1:
        return f"{value * 1000:.1f} ms" if value < 0.01 else f"{value * 1000:.0f} ms"
    return f"{value:.2f} s" if value < 1.0 else f"{value:.1f} s" if value < 10.0 else f"{value:.0f} s"


def duration(value: float) -> str:
    """A duration that a person waits, e.g. `40 s`, `12 min`, `3.5 h`, `4.2 days`."""
    for unit, length, most in (("s", 1.0, 90.0), ("min", 60.0, 5400.0)):
        if value < most:
            return f"{value / length:.0f} {unit}"
    return f"{value / 3600:.1f} h" if value < 48 * 3600 else f"{value / 86400:.1f} days"


def bytes_as_text(number: float) -> str:
    """Bytes in decimal units, e.g. `12.4 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.1f} TB"
