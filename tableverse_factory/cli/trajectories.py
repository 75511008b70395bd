"""`tableverse trajectories`: proven motions for the tasks of a dataset that is finished."""

from typing import Annotated

import typer

from tableverse_factory.cli.build import check_address, check_ready, run_and_conclude
from tableverse_factory.cli.cache import cache_folder
from tableverse_factory.cli.completions import config_keys
from tableverse_factory.cli.options import (
    Address,
    Executor,
    ExecutorName,
    Finished,
    Limit,
    Metrics,
    Pools,
    Shards,
    Workers,
)

SECTION = "trajectories"


def trajectories(
    out: Finished,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            autocompletion=config_keys,
            help="A key of the section trajectories; may repeat. All else is as it was built.",
        ),
    ] = None,
    executor: Executor = ExecutorName.RAY,
    workers: Workers = None,
    address: Address = None,
    pools: Pools = None,
    again: Annotated[
        bool, typer.Option("--again", help="Compute all trajectories again; needed where --set changed a value.")
    ] = False,
    limit: Limit = None,
    shards: Shards = None,
    metrics: Metrics = None,
) -> None:
    """Add motions, proven in simulation, to a finished dataset.

    The same command again goes on. Needs neither the manifest nor the pictures: a downloaded dataset will do. Nothing
    that is in it is computed again, and each shard stays as it is until all of its scenes are through. The result has
    the bytes of `build --stages +trajectories` from the start. Exit codes are those of `build`.

    Example: `tableverse trajectories out --workers 2 --set trajectories.max_tasks=5`
    """
    from tableverse_factory.core.pools_file import load_pools
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.shard_plan import shard_numbers
    from tableverse_factory.rebuild import config_from_run
    from tableverse_factory.run_record import read_run
    from workers.build import WITH_TRAJECTORIES, BuildRequest

    check_address(executor, address)
    place = parse_path(out)
    config = config_from_run(read_run(place / "run.json"), SECTION, overrides or [])
    check_ready(config, here=executor is ExecutorName.LOCAL or address is None)
    request = BuildRequest(
        manifest=None,
        out=place,
        config=config,
        cache_dir=cache_folder(),
        executor=executor.value,
        workers=workers,
        address=address,
        pools=load_pools(pools, config),
        begin_from=SECTION if again else None,
        limit=limit,
        shards=None if shards is None else shard_numbers(shards),
        pipeline=WITH_TRAJECTORIES,
    )
    run_and_conclude(request, out, metrics)
