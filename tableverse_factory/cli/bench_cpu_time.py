"""`tableverse bench layout | trajectories`: CPU time of scenes by stage, of trajectories by part, and success rates."""

import time
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile
from tableverse_factory.cli.tables import print_figures, print_json
from tableverse_factory.core.cache_dir import get_cache_dir
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    from schemas.scene import ExportedScene
    from tableverse_factory.evaluation.bench.stages import SceneCost
    from tableverse_factory.evaluation.bench.trajectories import TaskCost


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
    started = time.process_time()
    from tableverse_factory.evaluation.bench.stages import bench_stages

    imports_s = time.process_time() - started

    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.bench.measurement import sample_evenly
    from tableverse_factory.sources.manifest import make_manifest

    settings = load_config(config)
    rows = sample_evenly(make_manifest(paths, settings.observe).rows, most)
    if not rows:
        raise InputError("nothing to measure: give layout files, captures, or folders of them", "no_layouts")
    with count_progress("scenes", 2 * len(rows)) as done:
        costs = bench_stages(rows, settings, done)
    if as_json:
        print_json({"imports_s": imports_s, "scenes": costs})
    else:
        _show_costs(costs)
        print(f"imports, once in a process: {imports_s:.2f}")
    if all(cost.ended != "done" for cost in costs):
        raise typer.Exit(1)


def _show_costs(costs: list["SceneCost"]) -> None:
    from tableverse_factory.evaluation.bench.stages import compute_medians

    columns = {cache: compute_medians([cost for cost in costs if cost.cache == cache]) for cache in ("cold", "warm")}
    rows = ([name, *(f"{column.get(name, 0.0):.2f}" for column in columns.values())] for name in columns["cold"])
    print_figures(["CPU s, median", *columns], rows)
    done = [cost.objects for cost in costs if cost.ended == "done" and cost.cache == "warm"]
    print(f"{len(done)} scenes, {sum(done)} objects")
    for cost in costs:
        if cost.ended != "done" and cost.cache == "cold":
            print(f"not measured: {sanitize_line(cost.scene_id)}: {sanitize_line(cost.ended)}")


def bench_trajectories(
    dataset: Annotated[str, typer.Argument(help="A dataset with scenes: a folder, or s3://bucket/prefix.")],
    scenes: Annotated[int | None, typer.Option(min=1, help="Most scenes, in the order of shards.")] = None,
    tasks: Annotated[int | None, typer.Option(min=1, help="Most tasks per scene.")] = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the CPU time of trajectories and of their parts, and success rates by relation.

    Every accepted task is solved as the stage does it, in this process and on one thread, with its rollouts under
    changed friction and mass. Then its parts are measured one by one. Nothing is written.

    Example: `tableverse bench trajectories out --scenes 4 --tasks 10`
    """
    from threadpoolctl import threadpool_limits

    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.bench.trajectories import bench_trajectories
    from tableverse_factory.models.services import Services

    settings = load_config(config)
    found = _load_scenes(dataset, scenes)
    most = settings.trajectories.max_tasks if tasks is None else min(tasks, settings.trajectories.max_tasks)
    count = sum(min(most, sum(row["accepted"] for row in scene.task_rows)) for scene in found)
    if not count:
        raise InputError(f"{dataset}: no scene with an accepted task", "no_tasks")
    with count_progress("tasks", count) as done, threadpool_limits(1):
        costs = bench_trajectories(found, settings, Services(get_cache_dir()), most, done)
    if as_json:
        print_json(costs)
        return
    _show_times(costs)
    _show_rates(costs)


def _load_scenes(dataset: str, most: int | None) -> list["ExportedScene"]:
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.committed_scene import load_exported_scene
    from tableverse_factory.dataset.dataset import open_dataset

    rows = open_dataset(dataset).scenes.to_table(columns=["scene_id", "shard", "status"]).to_pylist()
    done = [row for row in rows if row["status"] == "done"][:most]
    found = (load_exported_scene(parse_path(dataset), int(row["shard"]), str(row["scene_id"])) for row in done)
    return [scene for scene in found if scene is not None]


def _show_times(costs: list["TaskCost"]) -> None:
    from tableverse_factory.evaluation.bench.trajectories import compute_quantiles, summarize_paths

    quantiles = compute_quantiles(costs).items()
    rows = ((name, count, f"{1e3 * median:.1f}", f"{1e3 * high:.1f}") for name, (count, median, high) in quantiles)
    print_figures(("CPU ms", "tasks", "median", "p95"), rows)
    problems, solved, length = summarize_paths(costs)
    if problems:
        print(f"paths: {solved} of {problems} problems solved, {length:.2f} rad in the median")


def _show_rates(costs: list["TaskCost"]) -> None:
    from tableverse_factory.evaluation.bench.trajectories import count_outcomes

    counts = count_outcomes(costs)
    rows = []
    for relation, count in counts.tasks.items():
        free = counts.free[relation]
        of_free = f"{counts.free_succeeded[relation] / free:.0%}" if free else ""
        rows.append((relation, count, f"{counts.succeeded[relation] / count:.0%}", free, of_free))
    print_figures(("relation", "tasks", "succeed", "nothing beside", "succeed"), rows)
    for name, share in counts.survived.items():
        print(f"{name}: {share:.0%} of the successes succeed too")
    for reason, count in counts.reasons.items():
        print(f"failed: {reason}: {count}")
