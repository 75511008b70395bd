"""`tableverse bench layout`: CPU time of scenes by stage."""

import time
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile
from tableverse_factory.cli.tables import make_figures_table, print_json, print_table

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.stages import SceneCost


def bench_stages(
    paths: Annotated[list[str], typer.Argument(help="Layout files, captures, or folders of them.")],
    most: Annotated[int | None, typer.Option(min=1, help="Most scenes, spread evenly over those found.")] = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure CPU seconds from file to committed MJCF by stage, with an empty cache and with a full one.

    Each scene runs twice, in this process and on one thread.

    Example: `tableverse synth demo --kind layouts && tableverse bench layout demo/layouts --most 12`
    """
    from dataclasses import asdict

    started = time.process_time()
    from tableverse_factory.evaluation.bench.stages import bench_stages

    imports_s = time.process_time() - started

    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.evaluation.bench.measurement import sample_evenly
    from tableverse_factory.sources.manifest import make_manifest

    settings = load_config(config)
    rows = sample_evenly(make_manifest(paths, settings.observe).rows, most)
    if not rows:
        raise InputError("nothing to measure: give layout files, captures, or folders of them", "no_layouts")
    with count_progress("scenes", 2 * len(rows)) as done:
        costs = bench_stages(rows, settings, done)
    if as_json:
        print_json({"imports_s": imports_s, "scenes": [asdict(cost) for cost in costs]})
    else:
        _show_costs(costs)
        print(f"imports, once in a process: {imports_s:.2f}")
    if all(cost.ended != "done" for cost in costs):
        raise typer.Exit(1)


def _show_costs(costs: list["SceneCost"]) -> None:
    from tableverse_factory.core.text import sanitize_line
    from tableverse_factory.evaluation.bench.stages import compute_medians

    columns = {cache: compute_medians([cost for cost in costs if cost.cache == cache]) for cache in ("cold", "warm")}
    table = make_figures_table("CPU s, median", *columns)
    for name in columns["cold"]:
        table.add_row(name, *(f"{column.get(name, 0.0):.2f}" for column in columns.values()))
    print_table(table)
    done = [cost.objects for cost in costs if cost.ended == "done" and cost.cache == "warm"]
    print(f"{len(done)} scenes, {sum(done)} objects")
    for cost in costs:
        if cost.ended != "done" and cost.cache == "cold":
            print(f"not measured: {sanitize_line(cost.scene_id)}: {sanitize_line(cost.ended)}")
