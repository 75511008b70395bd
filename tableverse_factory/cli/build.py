"""`tableverse build`: from the image manifest to the dataset; the same command again resumes."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli import options
from tableverse_factory.cli.completions import complete_stages

if TYPE_CHECKING:
    from workers.progress.tally import DisplayGroup
    from workers.run import BuildSummary

SOME_FAILED, OVER_BUDGET = 3, 4  # exit codes


def build(
    manifest: options.Manifest,
    out: Annotated[
        str,
        typer.Argument(
            metavar="OUT", help="The dataset, a folder or s3://bucket/prefix; begun before, the build goes on."
        ),
    ],
    config: options.ConfigFile = None,
    overrides: options.Overrides = None,
    executor: options.Executor = "ray",
    workers: options.Workers = None,
    address: options.Address = None,
    pools: options.Pools = None,
    from_stage: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="STAGE",
            autocompletion=complete_stages,
            help="Compute this stage and what follows again, for all scenes: "
            "observe, perceive, place, rectify, settle, curate, export or trajectories.",
        ),
    ] = None,
    stages: Annotated[
        str | None, typer.Option(metavar="+trajectories", help="Add trajectories for the tasks of every scene.")
    ] = None,
    limit: options.Limit = None,
    shards: options.Shards = None,
    max_usd: options.MaxUsd = None,
    max_calls: options.MaxCalls = None,
    keep: Annotated[
        bool,
        typer.Option(help="Keep what every stage gave, in OUT/.stages, when its shard is written: --from needs it."),
    ] = True,
    metrics: options.Metrics = None,
) -> None:
    """Build the dataset, or go on with it.

    The same command goes on after whatever stopped it, and ends with the same bytes.

    Exit code 0: every scene that was asked for is accounted for and none failed; 3: some failed (see
    `tableverse failures`), or a model did not answer for some; 4: the budget of --max-usd or --max-calls is spent; 1:
    the build cannot go on; 130 or 143: stopped by Ctrl-C or SIGTERM.

    `--stages +trajectories` adds validated motions; on a dataset that has none yet only these are computed.

    Example: `tableverse build images.parquet out --workers 2 --set run.seed=7`
    """
    import signal

    # Until the build handles signals, one ends the process: native code that imports modules drops KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from workers.api import build as run
    from workers.driver.signals import StopSignals

    summary = run(
        manifest,
        out,
        config=config,
        overrides=overrides or [],
        executor=executor,
        workers=workers,
        address=address,
        pools=pools,
        stages=stages,
        from_stage=from_stage,
        limit=limit,
        shards=shards,
        max_usd=max_usd,
        max_calls=max_calls,
        keep=keep,
        display=make_display(out, metrics),
        signals=StopSignals(),
    )
    report_summary(summary, out)


def make_display(out: str, metrics: Path | None) -> "DisplayGroup":
    """Make the display of a build: its progress on the terminal, and a file for Prometheus if one is wanted."""
    from workers.progress.console import OrderedConsole, ProgressDisplay
    from workers.progress.prometheus import MetricsFile, dataset_name
    from workers.progress.tally import DisplayGroup

    progress = ProgressDisplay(OrderedConsole(stderr=True))
    return DisplayGroup(progress, *(() if metrics is None else (MetricsFile(metrics, dataset_name(out)),)))


def report_summary(summary: "BuildSummary", out: str) -> None:
    """Print how a build ended, and end the process with its exit code unless that is 0."""
    from tableverse_factory.cli.failures import format_dropped
    from tableverse_factory.core.text import pluralize
    from tableverse_factory.dataset.model_costs import format_cost
    from workers.driver.signals import STOPPED_MESSAGE

    tally = summary.tally
    if summary.signal:
        print(f"{tally.accounted} of {pluralize(tally.total, 'scene')} accounted for; {STOPPED_MESSAGE}")
        raise typer.Exit(128 + summary.signal)
    state = summary.read_state()
    left = pluralize(state.remaining, "scene")
    if summary.over_budget is not None:
        print(f"the budget is spent: {format_cost(summary.over_budget)}, in all runs of this dataset")
        print(f"still to do: {left}; run the same command with a larger --max-usd or --max-calls")
    elif state.remaining > tally.postponed:
        print(f"still to do: {left}; run it again, without --limit or --shards for all of them")
    if tally.before == tally.total:
        print("nothing was left to do" if tally.total else "the manifest has no row: this dataset is empty")
    planned = pluralize(state.total, "scene")
    print(f"{state.done} done, {state.dropped} dropped, {state.failed} failed of {planned}, in {out}")
    if state.done:
        place = shlex.quote(str(out))
        print(f"look at them: tableverse view {place}, or a gallery of files: tableverse report {place}")
    if state.failed:
        print(f"see why: tableverse failures {shlex.quote(str(out))}")
    if state.dropped:
        print(format_dropped(state.dropped, str(out)))
    if tally.postponed:
        later = pluralize(tally.postponed, "scene")
        print(f"left for a later run: {later}, because a model did not answer; run it again for them")
    if summary.over_budget is not None:
        raise typer.Exit(OVER_BUDGET)
    if state.failed or tally.postponed:
        raise typer.Exit(SOME_FAILED)
