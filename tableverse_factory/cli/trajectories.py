"""`tableverse trajectories`: validated trajectories for the tasks of a finished dataset."""

from typing import Annotated

import typer

from tableverse_factory.cli import options
from tableverse_factory.cli.build import make_display, report_summary


def trajectories(
    out: options.FinishedOut,
    overrides: options.Overrides = None,
    executor: options.Executor = "ray",
    workers: options.Workers = None,
    address: options.Address = None,
    pools: options.Pools = None,
    again: Annotated[
        bool, typer.Option("--again", help="Compute all trajectories again; needed where --set changed a value.")
    ] = False,
    limit: options.Limit = None,
    shards: options.Shards = None,
    metrics: options.Metrics = None,
) -> None:
    """Add motions, validated in simulation, to a finished dataset.

    `--set` changes keys of the section trajectories; all else is as it was built.

    The same command again goes on. Needs neither the manifest nor the pictures: a downloaded dataset will do. Nothing
    that is in it is computed again, and each shard stays as it is until all of its scenes are through. The result has
    the bytes of `build --stages +trajectories` from the start. Exit codes are those of `build`.

    Example: `tableverse trajectories out --workers 2 --set trajectories.max_tasks=5`
    """
    from workers.api import build
    from workers.driver.signals import StopSignals

    summary = build(
        None,
        out,
        overrides=overrides or [],
        executor=executor,
        workers=workers,
        address=address,
        pools=pools,
        from_stage="trajectories" if again else None,
        limit=limit,
        shards=shards,
        display=make_display(out, metrics),
        signals=StopSignals(),
    )
    report_summary(summary, out)
