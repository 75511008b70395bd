"""`tableverse build`: from the image manifest to the dataset; the same command again goes on."""

import difflib
import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.cache import cache_folder
from tableverse_factory.cli.completions import stages as stage_names
from tableverse_factory.cli.options import (
    Address,
    ConfigFile,
    Executor,
    ExecutorName,
    Limit,
    Manifest,
    MaxCalls,
    MaxUsd,
    Metrics,
    Overrides,
    Pools,
    Shards,
    Workers,
)

if TYPE_CHECKING:
    from schemas.config import AskedSection, Config
    from tableverse_factory.core.storage.files import StoragePath
    from workers.build import BuildRequest, Summary
    from workers.driver.budget import SpendingLimits

SOME_FAILED = 3
OVER_BUDGET = 4
ADDED = "+trajectories"
"""What `--stages` takes."""


def build(
    manifest: Manifest,
    out: Annotated[
        str,
        typer.Argument(
            metavar="OUT", help="The dataset, a folder or s3://bucket/prefix; begun before, the build goes on."
        ),
    ],
    config: ConfigFile = None,
    overrides: Overrides = None,
    executor: Executor = ExecutorName.RAY,
    workers: Workers = None,
    address: Address = None,
    pools: Pools = None,
    begin_from: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="STAGE",
            autocompletion=stage_names,
            help="Compute this stage and what follows again, for all scenes: "
            "observe, perceive, place, rectify, settle, curate, export or trajectories.",
        ),
    ] = None,
    stages: Annotated[
        str | None,
        typer.Option(metavar=ADDED, help="More stages than the usual line: motions for the tasks of every scene."),
    ] = None,
    limit: Limit = None,
    shards: Shards = None,
    max_usd: MaxUsd = None,
    max_calls: MaxCalls = None,
    keep: Annotated[
        bool,
        typer.Option(help="Keep what every stage gave, in OUT/.stages, when its shard is written: --from needs it."),
    ] = True,
    metrics: Metrics = None,
) -> None:
    """Build the dataset, or go on with it.

    The same command goes on after whatever stopped it, and ends with the same bytes.

    Exit code 0: every scene that was asked for is accounted for and none failed; 3: some failed (see
    `tableverse failures`), or a model did not answer for some; 4: the budget of --max-usd or --max-calls is spent; 1:
    the build cannot go on; 130 or 143: stopped by Ctrl-C or SIGTERM.

    `--stages +trajectories` ends the line with proven motions; on a dataset that has none yet only these are computed.

    Example: `tableverse build images.parquet out --workers 2 --set run.seed=7`
    """
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.pools_file import load_pools
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.shard_plan import shard_numbers
    from workers.build import WITH_TRAJECTORIES, BuildRequest

    pipeline = _pipeline(stages, begin_from)
    check_address(executor, address)
    _check_above(parse_path(out))
    settings = load_config(config, overrides or [])
    if pipeline == WITH_TRAJECTORIES:
        check_ready(settings, here=executor is ExecutorName.LOCAL or address is None)
    request = BuildRequest(
        manifest=parse_path(manifest),
        out=parse_path(out),
        config=settings,
        cache_dir=cache_folder(),
        executor=executor.value,
        workers=workers,
        address=address,
        pools=load_pools(pools, settings),
        begin_from=begin_from,
        limit=limit,
        shards=None if shards is None else shard_numbers(shards),
        limits=limits_of(settings, max_usd, max_calls),
        keep=keep,
        pipeline=pipeline,
    )
    run_and_conclude(request, out, metrics)


def limits_of(config: "Config", max_usd: float | None, max_calls: int | None) -> "SpendingLimits":
    """The budget that was given.

    Raises:
        ConfigError: if money is to be counted and a model that is asked has no price.
    """
    from tableverse_factory.core.errors import ConfigError
    from tableverse_factory.dataset.model_costs import MODEL_ROLE_BY_STAGE
    from workers.driver.budget import SpendingLimits

    if max_usd is not None and not math.isfinite(max_usd):
        raise ConfigError(f"--max-usd {max_usd}: give an amount of money")
    for stage in MODEL_ROLE_BY_STAGE if max_usd is not None else ():
        section: AskedSection = getattr(config, stage)
        if section.asked and not (section.usd_per_million_input or section.usd_per_million_output):
            raise ConfigError(
                f"--max-usd needs the price of {section.model}: set {stage}.usd_per_million_input and "
                f"{stage}.usd_per_million_output, or give --max-calls"
            )
    return SpendingLimits(max_calls, max_usd)


def check_address(executor: ExecutorName, address: str | None) -> None:
    """Refuses an address that is none, before anything else is looked at.

    Raises:
        BuildError: saying what is wrong with it.
    """
    from workers.executors.ray_address import host_and_port

    if executor is ExecutorName.RAY and address not in (None, "auto"):
        host_and_port(str(address))


def run_and_conclude(request: "BuildRequest", out: str, metrics: Path | None) -> None:
    """Runs the build with its progress on the terminal, and says how it ended.

    Args:
        request: What to build.
        out: The dataset, as it was given.
        metrics: File for Prometheus, if one is wanted.

    Raises:
        typer.Exit: with the exit code, where it is not 0.
    """
    from rich.console import Console

    from tableverse_factory.cli.progress import ProgressDisplay
    from workers.build import run_build
    from workers.progress.prometheus import MetricsFile, dataset_name
    from workers.progress.tally import Display, Displays

    with ExitStack() as shown:
        displays: list[Display] = [shown.enter_context(ProgressDisplay(Console(stderr=True)))]
        if metrics is not None:
            displays.append(shown.enter_context(MetricsFile(metrics, dataset_name(out))))
        summary = run_build(request, Displays(*displays))
    _conclude(summary, out)


def check_ready(config: "Config", here: bool) -> None:
    """Looks for what trajectories are made with before anything waits for it, or is taken back for it.

    Args:
        config: Of the build.
        here: Whether its stages run on this machine.

    Raises:
        TableverseError: saying what is missing, and the remedy.
    """
    from tableverse_factory.stages.trajectories.preflight import check_all

    check_all(config.trajectories, here)


def _pipeline(stages: str | None, begin_from: str | None) -> str:
    """Where the lines are that were asked for; who begins again from the stage that can be added means it to be there.

    Raises:
        ConfigError: if other stages are asked for than there are.
    """
    from schemas.config import Config, StageSection
    from tableverse_factory.core.errors import ConfigError
    from workers.build import PIPELINE, WITH_TRAJECTORIES

    known = [name for name in Config.model_fields if isinstance(getattr(Config(), name), StageSection)]
    if begin_from is not None and begin_from not in known:
        near = difflib.get_close_matches(begin_from, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        raise ConfigError(f"--from {begin_from[:80]!r}: no such stage; {hint}")

    if stages not in (None, ADDED):
        raise ConfigError(f"--stages {stages[:80]!r}: give {ADDED}, or leave it out for the usual line")
    return WITH_TRAJECTORIES if stages == ADDED or begin_from == ADDED.removeprefix("+") else PIPELINE


def _check_above(out: "StoragePath") -> None:
    from tableverse_factory.core.errors import InputError

    if isinstance(out, Path) and (file := next((above for above in out.parents if above.is_file()), None)):
        raise InputError(f"{file} is a file: give another OUT")


def _conclude(summary: "Summary", out: str) -> None:
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.core.text import pluralize
    from tableverse_factory.dataset.model_costs import format_cost
    from workers.build import PARTING_WORDS
    from workers.progress.build_state import survey

    tally = summary.tally
    if summary.signal:
        print(f"{tally.accounted} of {pluralize(tally.total, 'scene')} accounted for; {PARTING_WORDS}")
        raise typer.Exit(128 + summary.signal)
    found = survey(parse_path(out))
    if summary.over_budget is not None:
        print(f"the budget is spent: {format_cost(summary.over_budget)}, in all runs of this dataset")
        left = pluralize(found.remaining, "scene")
        print(f"still to do: {left}; run the same command with a larger --max-usd or --max-calls")
    elif found.remaining > tally.postponed:
        left = pluralize(found.remaining, "scene")
        print(f"still to do: {left}; run it again, without --limit or --shards for all of them")
        print(f"rows and files appear when their shard is whole: {found.committed} of {found.shards} shards are")
    if tally.before == tally.total:
        print("nothing was left to do")
    planned = pluralize(found.total, "scene")
    print(f"{found.done} done, {found.dropped} dropped, {found.failed} failed of {planned}, in {out}")
    if found.done and found.committed:
        print(f"look at them: tableverse view {out}, or a gallery of files: tableverse report {out}")
    if found.failed:
        print(f"see why: tableverse failures {out}")
    if tally.postponed:
        left = pluralize(tally.postponed, "scene")
        print(f"left for a later run: {left}, because a model did not answer; run it again for them")
    if summary.over_budget is not None:
        raise typer.Exit(OVER_BUDGET)
    if found.failed or tally.postponed:
        raise typer.Exit(SOME_FAILED)
