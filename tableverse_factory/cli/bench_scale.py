"""`tableverse bench factory` and `bench query`: overhead of builds, and query times of datasets."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson
from tableverse_factory.cli.tables import print_figures, print_json
from tableverse_factory.core.errors import ConfigError

_MAX_SCENES, _MAX_PAYLOAD_BYTES = 1_000_000, 10**9

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.factory import FactoryRun
    from tableverse_factory.evaluation.bench.query import QueryTimes


def bench_factory(
    sizes: Annotated[str, typer.Option(help="Scenes of each build, separated by commas.")] = "1000,10000,100000",
    workers: Annotated[int, typer.Option(min=1, help="Ray workers, compared with one.")] = 2,
    burning: Annotated[
        int, typer.Option(min=0, help="Scenes of the builds whose stages burn CPU; 0 skips them.")
    ] = 400,
    payload: Annotated[str, typer.Option(help="Size of the files of each scene, e.g. 7MB.")] = "0",
    as_json: AsJson = False,
) -> None:
    """Measure the overhead of the factory: stages that do nothing, real sandboxes, commits to disk; and Ray Data.

    Ray Data needs pandas (`pip install 'tableverse-factory[bench]'`) and is left out without it.

    Example: `tableverse bench factory --sizes 300,1000,3000 --burning 100`
    """
    import sys
    from functools import partial

    from tableverse_factory.evaluation.bench.factory import bench_factory, compare_runs

    asked, payload_bytes, runs = _parse_sizes(sizes), _parse_bytes(payload), []
    show = partial(print, end=" … ", file=sys.stderr, flush=True)
    for run in bench_factory(asked, workers, burning, payload_bytes, show):
        print(f"{run.rate:.0f} scenes/s, {run.total_cpu_ms:.2f} ms of CPU each", file=sys.stderr)
        runs.append(run)
    ratios = compare_runs(runs)
    if as_json:
        print_json({"runs": runs, "ratios": ratios})
        return
    _show_runs(runs)
    told = (
        (ratios.linear, f"marginal CPU time per scene, larger builds over smaller ones: {ratios.linear:.2f}"),
        (ratios.ray_ms, f"CPU time that Ray adds per scene: {ratios.ray_ms:.2f} ms"),
        (ratios.speed_up, f"speed of {workers} workers that burn CPU over that of one: {ratios.speed_up:.2f}"),
        (ratios.to_ray_data, f"marginal rate of the factory over that of Ray Data: {ratios.to_ray_data:.2f}"),
    )
    for ratio, line in told:
        if not math.isnan(ratio):
            print(line)


def _show_runs(runs: list["FactoryRun"]) -> None:
    rows = []
    for run in runs:
        cpu = (f"{run.total_cpu_ms:.2f}", f"{run.driver_ms:.2f}", f"{run.driver_kb:.1f}")
        rates = (f"{run.rate:.0f}", f"{run.steady_rate:.0f}")
        memory = (f"{run.peak_mb:.0f}", f"{run.growth_mb:+.1f}")
        rows.append((run.what, run.workers, run.scenes, *rates, *cpu, *memory))
    figures = ("workers", "scenes", "scenes/s", "flowing", "CPU ms", "driver ms", "KB", "peak MB", "MB per 10,000")
    print_figures(("build", *figures), rows)
    print("flowing: after the first finished scenes; CPU ms: per scene over all processes, starts and imports included")
    print("driver ms, KB: its CPU time and traffic per scene while they flow: bytes read, written, sent and received")
    print("(files, pipes, TCP, its own sandbox), and objects that it moves into Ray's object store or out of it")


def _parse_sizes(text: str) -> list[int]:
    """Parse numbers of scenes such as `1000,10000`; return each once, ascending."""
    parts = [part.strip() for part in text.split(",")]
    for part in parts:
        if not re.fullmatch(r"[0-9]{1,7}", part) or not 1 <= int(part) <= _MAX_SCENES:
            raise ConfigError(f"--sizes {part[:80]!r}: give numbers from 1 to {_MAX_SCENES}, separated by commas")
    return sorted(set(map(int, parts)))


def _parse_bytes(text: str) -> int:
    """Parse a number of bytes such as `7MB`."""
    match = re.fullmatch(r"([0-9]{1,10}) ?(k|M|G)?B?", text)
    size = int(match[1]) * {None: 1, "k": 10**3, "M": 10**6, "G": 10**9}[match[2]] if match else -1
    if not 0 <= size <= _MAX_PAYLOAD_BYTES:
        raise ConfigError(f"--payload {text[:80]!r}: give a number of bytes up to 1GB, such as 7MB")
    return size


def bench_query(
    out: Annotated[
        Path | None, typer.Argument(help="A dataset; by default, datasets are written for the bench.", exists=True)
    ] = None,
    scenes: Annotated[int, typer.Option(min=100, help="Scenes of the datasets written for the bench.")] = 100_000,
    as_json: AsJson = False,
) -> None:
    """Measure filters, counts and scenes by id: small and large shards, with and without merged tables.

    Example: `tableverse bench query --scenes 10000`
    """
    import sys
    import tempfile

    from tableverse_factory.dataset.consolidated_tables import write_merged_tables
    from tableverse_factory.evaluation.bench.query import bench_query, write_query_dataset

    times = [bench_query(out, "this one")] if out else []
    for shard_size in () if out else (64, 10_000):
        with tempfile.TemporaryDirectory(prefix="tableverse-bench-") as folder:
            print(f"writing {scenes} scenes, {shard_size} in a shard …", file=sys.stderr)
            shards = write_query_dataset(Path(folder) / "out", scenes, shard_size)
            times.append(bench_query(Path(folder) / "out", f"{shard_size} in a shard"))
            write_merged_tables(Path(folder) / "out", shards)
            if (Path(folder) / "out" / "merged").exists():
                times.append(bench_query(Path(folder) / "out", "the same, merged"))
    if as_json:
        print_json(times)
    else:
        _show_times(times)


def _show_times(times: list["QueryTimes"]) -> None:
    rows = []
    for t in times:
        figures = (t.filter_ms, t.cpu_ms, t.anew_ms, t.count_ms, t.scene_ms, t.first_ms)
        rows.append((t.what, t.shards, t.scenes, t.objects, *(f"{value:.1f}" for value in figures)))
    names = ("shards", "scenes", "objects", "filter ms", "CPU ms", "anew", "count", "scene", "first scene")
    print_figures(("dataset", *names), rows)
    print("medians in ms; anew and first scene include opening the dataset")
