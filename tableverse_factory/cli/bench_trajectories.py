"""`tableverse bench trajectories`: what motions cost, part by part, and how many succeed."""

from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile

if TYPE_CHECKING:
    from schemas.scene import ExportedScene
    from tableverse_factory.evaluation.bench.trajectories import TaskCost


def bench_trajectories(
    dataset: Annotated[str, typer.Argument(help="A dataset with scenes: a folder, or s3://bucket/prefix.")],
    scenes: Annotated[int | None, typer.Option(min=1, help="At most so many scenes, in the order of shards.")] = None,
    tasks: Annotated[int | None, typer.Option(min=1, help="At most so many tasks of each.")] = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Measure the CPU seconds of trajectories and of their parts, and how many tasks succeed, by relation.

    Every accepted task is solved as the stage does it, in this process and on one thread, with its rollouts under
    changed friction and mass. Then its parts are measured by themselves. Where OMPL is installed
    (`pip install 'tableverse-factory[bench]'`), it solves the same path problems with the same collision checks.
    Nothing is written.

    Example: `tableverse bench trajectories out --scenes 4 --tasks 10`
    """
    import json
    from dataclasses import asdict

    from threadpoolctl import threadpool_limits

    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.evaluation.bench.ompl_planner import has_ompl
    from tableverse_factory.evaluation.bench.trajectories import bench_trajectories
    from tableverse_factory.models.services import Services

    settings, ompl = load_config(config), has_ompl()
    found = _scenes(dataset, scenes)
    most = settings.trajectories.max_tasks if tasks is None else min(tasks, settings.trajectories.max_tasks)
    count = sum(min(most, sum(row["accepted"] for row in scene.task_rows)) for scene in found)
    if not count:
        raise InputError(f"{dataset}: no scene with an accepted task", "no_tasks")
    with counter("tasks", count) as done, threadpool_limits(1):
        costs = bench_trajectories(found, settings, Services(cache_folder()), ompl, most, done)
    if as_json:
        print(json.dumps([asdict(cost) for cost in costs], indent=2))
        return
    _show_times(costs)
    _show_rates(costs)
    if not ompl:
        print("OMPL is not installed: pip install 'tableverse-factory[bench]'")


def _scenes(dataset: str, most: int | None) -> list["ExportedScene"]:
    """The scenes that are done, as they left export."""
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.committed_scene import load_exported_scene
    from tableverse_factory.dataset.dataset import open_dataset

    rows = open_dataset(dataset).scenes.to_table(columns=["scene_id", "shard", "status"]).to_pylist()
    done = [row for row in rows if row["status"] == "done"][:most]
    found = (load_exported_scene(parse_path(dataset), int(row["shard"]), str(row["scene_id"])) for row in done)
    return [scene for scene in found if scene is not None]


def _show_times(costs: list["TaskCost"]) -> None:
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.evaluation.bench.trajectories import path_lengths, quantiles

    table = Table("CPU ms", box=None, pad_edge=False)
    for name in ("tasks", "median", "p95"):
        table.add_column(name, justify="right")
    for name, (count, median, high) in quantiles(costs).items():
        table.add_row(name, str(count), f"{1e3 * median:.1f}", f"{1e3 * high:.1f}")
    Console(markup=False).print(table)
    for name, (count, solved, length) in path_lengths(costs).items():
        print(f"{name}: {solved} of {count} problems solved, paths of {length:.2f} rad in the median")


def _show_rates(costs: list["TaskCost"]) -> None:
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.evaluation.bench.trajectories import rates

    found = rates(costs)
    table = Table("relation", box=None, pad_edge=False)
    for name in ("tasks", "succeed", "nothing beside", "succeed"):
        table.add_column(name, justify="right")
    for relation, count in found.tasks.items():
        free = found.free[relation]
        of_free = f"{found.free_succeeded[relation] / free:.0%}" if free else ""
        table.add_row(relation, str(count), f"{found.succeeded[relation] / count:.0%}", str(free), of_free)
    Console(markup=False).print(table)
    for name, share in found.survived.items():
        print(f"{name}: {share:.0%} of the successes succeed too")
    for reason, count in found.reasons.items():
        print(f"failed: {reason}: {count}")
