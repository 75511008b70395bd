"""`tableverse trajectories`: proven motions for the tasks of a dataset that is finished."""

from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.build import ExecutorName, check_ready, run_and_conclude
from tableverse_factory.cli.cache import cache_folder

SECTION = "trajectories"


def trajectories(
    out: Annotated[str, typer.Argument(help="A finished dataset: a folder, or s3://bucket/prefix.")],
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="trajectories.key=value, may repeat; all else is as it was built.")
    ] = None,
    executor: Annotated[ExecutorName, typer.Option(help="One process, or Ray.")] = ExecutorName.RAY,
    workers: Annotated[int | None, typer.Option(min=1, help="Calls in flight on Ray; one per CPU by default.")] = None,
    address: Annotated[
        str | None, typer.Option(envvar="RAY_ADDRESS", help="A running Ray cluster: auto or HOST:PORT.")
    ] = None,
    pools: Annotated[
        Path | None, typer.Option(help="YAML: what the actors of each pool hold (docs/building.md).")
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Compute all trajectories again; needed where --set changed a value.")
    ] = False,
    limit: Annotated[int | None, typer.Option(min=1, help="Stop after so many scenes.")] = None,
    shards: Annotated[str | None, typer.Option(help="Work on these shards only, e.g. 3-7,9.")] = None,
    metrics: Annotated[
        Path | None, typer.Option(help="Keep figures for Prometheus in this file (docs/monitoring.md).")
    ] = None,
) -> None:
    """Add motions, proven in simulation, to a finished dataset.

    The same command again goes on. Needs neither the manifest nor the pictures: a downloaded dataset will do. Nothing
    that is in it is computed again, and each shard stays as it is until all of its scenes are through. The result has
    the bytes of `build --stages +trajectories` from the start. Exit codes are those of `build`.

    Example: `tableverse trajectories out --workers 2 --set trajectories.max_tasks=5`
    """
    from tableverse_factory.plan import shard_numbers
    from tableverse_factory.pools import load_pools
    from tableverse_factory.provenance import read_run
    from tableverse_factory.restored import restored_config
    from tableverse_factory.storage import place_of
    from workers.address import host_and_port
    from workers.build import WITH_TRAJECTORIES, Request

    if executor is ExecutorName.RAY and address not in (None, "auto"):
        host_and_port(str(address))
    place = place_of(out)
    config = restored_config(read_run(place / "run.json"), SECTION, overrides or [])
    check_ready(config, here=executor is ExecutorName.LOCAL or address is None)
    request = Request(
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
