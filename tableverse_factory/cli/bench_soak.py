"""`tableverse bench soak`: builds that are killed again and again."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, require_local_path
from tableverse_factory.cli.tables import print_figures, print_json

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.soak import SoakReport


def bench_soak(
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT", callback=require_local_path, help="A new or empty folder, or that of an earlier soak test."
        ),
    ],
    scenes: Annotated[int, typer.Option(min=1, max=1_000_000, help="Synthetic captures of each build.")] = 300,
    minutes: Annotated[float, typer.Option(min=0.1, max=10_000, help="How long builds are disturbed.")] = 30.0,
    kill_every_s: Annotated[
        float, typer.Option("--kill-every", min=5.0, max=86_400, metavar="S", help="Seconds between two kills.")
    ] = 60.0,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Ray workers.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Of the captures and of the kills.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Kill driver, actors and sandboxes at random while synthetic captures are built on Ray, and check the result.

    One build runs undisturbed. Then builds follow, each in a fresh folder, until the time is over: every --kill-every
    seconds a random process gets SIGKILL, and after the driver's death the same command goes on. Each must account for
    every scene with the bytes of the undisturbed build, timings aside; the last one is verified.

    Exit code 1: a build or a scene is wrong, or a process that lived for 3 minutes or more gained over 10 % of memory
    in the second half of its life. OUT keeps the builds.

    Example: `tableverse bench soak soaked --scenes 50 --minutes 10 --kill-every 30`
    """
    import sys
    import time
    from dataclasses import asdict

    from tableverse_factory.evaluation.bench.soak import SoakPlan, run_soak

    plan = SoakPlan(out, scenes, workers, 60.0 * minutes, kill_every_s, seed)
    report = run_soak(plan, lambda line: print(time.strftime("%H:%M:%S"), line, file=sys.stderr, flush=True))
    if as_json:
        print_json({"ok": not report.problems, **asdict(report)})
    else:
        _show_report(report)
    if report.problems:
        raise typer.Exit(1)


def _show_report(report: "SoakReport") -> None:
    rows = []
    for kind in report.memory:
        growth = f"{100 * kind.growth:+.1f}" if kind.long_lived else "–"
        kills = report.kills.get(kind.kind, 0)
        rows.append((kind.kind, kind.processes, kills, f"{kind.peak_mb:.0f}", kind.long_lived, growth))
    print_figures(("process", "seen", "killed", "peak MB", "lived long", "growth %"), rows)
    print("growth: the largest of a process that lived for 3 minutes or more, over the second half of its life")
    print(f"disturbed builds that completed: {report.builds}; problems: {len(report.problems)}")
    for problem in report.problems:
        print(f"    {problem}")
