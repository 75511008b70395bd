"""`tableverse bench factory` and `bench query`: what many scenes cost, while they are made and afterwards."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson

if TYPE_CHECKING:
    from rich.table import Table

    from tableverse_factory.evaluation.bench.factory import FactoryRun
    from tableverse_factory.evaluation.bench.query import QueryTimes


def bench_factory(
    sizes: Annotated[str, typer.Option(help="Scenes of the builds, separated by commas.")] = "1000,10000,100000",
    workers: Annotated[int, typer.Option(min=1, help="Of Ray, compared with one.")] = 2,
    burning: Annotated[int, typer.Option(min=0, help="Scenes whose stages burn CPU, for the speed-up; 0: none.")] = 400,
    as_json: AsJson = False,
) -> None:
    """Measure what the factory itself costs: stages that do nothing, real sandboxes, commits to disk; Ray Data beside.

    Ray Data takes part where pandas is installed (`pip install 'tableverse-factory[bench]'`).

    Example: `tableverse bench factory --sizes 300,1000,3000 --burning 100`
    """
    import json
    import sys
    from dataclasses import asdict

    from tableverse_factory.evaluation.bench.factory import bench_factory, compare

    asked = sorted({int(size) for size in sizes.split(",")})
    runs = []
    for run in bench_factory(asked, workers, burning, lambda what: print(what, end=" … ", file=sys.stderr, flush=True)):
        print(f"{run.rate:.0f} scenes/s, {run.total_cpu_ms:.2f} ms of CPU each", file=sys.stderr)
        runs.append(run)
    ratios = compare(runs)
    if as_json:
        print(json.dumps({"runs": [asdict(run) for run in runs], "ratios": asdict(ratios)}, indent=2))
        return
    _show_runs(runs)
    print(f"cost of one scene more, from the larger to the largest build over the smaller: {ratios.linear:.2f}")
    print(
        f"Ray costs {ratios.ray_ms:.2f} ms of CPU a scene; {workers} workers burn {ratios.speed_up:.2f} times as fast"
    )
    print(f"one scene more, Ray Data's time over the factory's: {ratios.to_ray_data:.2f}")


def _show_runs(runs: list["FactoryRun"]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("build", no_wrap=True)
    for name in ("workers", "scenes", "scenes/s", "flowing", "CPU ms", "driver", "peak MB", "MB per 10,000"):
        table.add_column(name, justify="right", no_wrap=True)
    for run in runs:
        cpu = (f"{run.total_cpu_ms:.2f}", f"{run.cpu_ms.get('driver', 0.0):.2f}")
        rates = (f"{run.rate:.0f}", f"{run.steady_rate:.0f}")
        memory = (f"{run.peak_mb:.0f}", f"{run.growth_mb:+.1f}")
        table.add_row(run.what, str(run.workers), str(run.scenes), *rates, *cpu, *memory)
    _print_whole(table)
    print("CPU ms: per scene over all processes, and the driver's part; flowing: once scenes are being finished")


def bench_query(
    out: Annotated[
        Path | None, typer.Argument(help="A dataset; without it, datasets are written for this.", exists=True)
    ] = None,
    scenes: Annotated[int, typer.Option(min=100, help="Scenes of the datasets written for this.")] = 100_000,
    as_json: AsJson = False,
) -> None:
    """Measure how long filters, counts and scenes by id take: small and large shards, with and without merged tables.

    Example: `tableverse bench query --scenes 10000`
    """
    import json
    import sys
    import tempfile
    from dataclasses import asdict

    from tableverse_factory.dataset.consolidated_tables import write_merged
    from tableverse_factory.evaluation.bench.query import bench_query, write_dataset

    times = [bench_query(out, "this one")] if out else []
    for shard_size in () if out else (64, 10_000):
        with tempfile.TemporaryDirectory(prefix="tableverse-bench-") as folder:
            print(f"writing {scenes} scenes, {shard_size} in a shard …", file=sys.stderr)
            shards = write_dataset(Path(folder) / "out", scenes, shard_size)
            times.append(bench_query(Path(folder) / "out", f"{shard_size} in a shard"))
            write_merged(Path(folder) / "out", shards)
            if (Path(folder) / "out" / "merged").exists():
                times.append(bench_query(Path(folder) / "out", "the same, merged"))
    if as_json:
        print(json.dumps([asdict(entry) for entry in times], indent=2))
    else:
        _show_times(times)


def _show_times(times: list["QueryTimes"]) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("dataset", no_wrap=True)
    for name in ("shards", "scenes", "objects", "filter ms", "CPU ms", "anew", "count", "scene", "first scene"):
        table.add_column(name, justify="right", no_wrap=True)
    for t in times:
        figures = (t.filter_ms, t.cpu_ms, t.anew_ms, t.count_ms, t.scene_ms, t.first_ms)
        table.add_row(t.what, str(t.shards), str(t.scenes), str(t.objects), *(f"{value:.1f}" for value in figures))
    _print_whole(table)
    print("medians in ms; anew and first scene open the dataset for it")


def _print_whole(table: "Table") -> None:
    """A table that is wider than the terminal is better wrapped by it than cut."""
    from rich.console import Console

    width = Console(width=1000).measure(table).maximum
    Console(markup=False, width=max(width, Console().width)).print(table)
