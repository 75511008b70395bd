"""`tableverse bench trajectories`: CPU time of trajectories by part, and success rates."""

from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile
from tableverse_factory.cli.tables import make_figures_table, print_json, print_table

if TYPE_CHECKING:
    from schemas.scene import ExportedScene
    from tableverse_factory.evaluation.bench.trajectories import TaskCost


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
    from dataclasses import asdict

    from threadpoolctl import threadpool_limits

    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.cache_dir import get_cache_dir
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.errors import InputError
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
        print_json([asdict(cost) for cost in costs])
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

    table = make_figures_table("CPU ms", "tasks", "median", "p95")
    for name, (count, median, high) in compute_quantiles(costs).items():
        table.add_row(name, str(count), f"{1e3 * median:.1f}", f"{1e3 * high:.1f}")
    print_table(table)
    problems, solved, length = summarize_paths(costs)
    if problems:
        print(f"paths: {solved} of {problems} problems solved, {length:.2f} rad in the median")


def _show_rates(costs: list["TaskCost"]) -> None:
    from tableverse_factory.evaluation.bench.trajectories import count_outcomes

    counts = count_outcomes(costs)
    table = make_figures_table("relation", "tasks", "succeed", "nothing beside", "succeed")
    for relation, count in counts.tasks.items():
        free = counts.free[relation]
        of_free = f"{counts.free_succeeded[relation] / free:.0%}" if free else ""
        table.add_row(relation, str(count), f"{counts.succeeded[relation] / count:.0%}", str(free), of_free)
    print_table(table)
    for name, share in counts.survived.items():
        print(f"{name}: {share:.0%} of the successes succeed too")
    for reason, count in counts.reasons.items():
        print(f"failed: {reason}: {count}")
