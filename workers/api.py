"""Builds from Python, on the same code path as the commands `tableverse build` and `tableverse trajectories`."""

import difflib
import json
import math
import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

from schemas.config import Config, RemoteModelSection, StageSection
from tableverse_factory.core.cache_dir import get_cache_dir
from tableverse_factory.core.config import load_config
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.pools_file import load_pools
from tableverse_factory.core.storage.files import StoragePath, parse_path
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.model_costs import MODEL_ROLE_BY_STAGE
from tableverse_factory.dataset.shard_plan import parse_shards
from tableverse_factory.rebuild import config_from_run
from tableverse_factory.run_record import read_run
from workers.driver.budget import SpendingLimits
from workers.driver.signals import StopSignals
from workers.executors.ray_address import parse_host_port
from workers.progress.notebook import open_display
from workers.progress.tally import Display
from workers.run import PIPELINE, WITH_TRAJECTORIES, BuildRequest, BuildSummary, ExecutorName, run_build

ADDED_STAGES = "+trajectories"  # value of `--stages`: stages that are added to the usual ones
TRAJECTORIES = "trajectories"


def build(
    manifest: str | os.PathLike[str] | None,
    out: str | os.PathLike[str],
    *,
    config: str | os.PathLike[str] | None = None,
    overrides: Mapping[str, object] | Sequence[str] = (),
    executor: ExecutorName = "local",
    workers: int | None = None,
    address: str | None = None,
    pools: str | os.PathLike[str] | None = None,
    stages: str | None = None,
    from_stage: str | None = None,
    limit: int | None = None,
    shards: str | Collection[int] | None = None,
    max_usd: float | None = None,
    max_calls: int | None = None,
    keep: bool = True,
    display: Display | Literal["auto"] | None = "auto",
    signals: StopSignals | None = None,
) -> BuildSummary:
    """Build a dataset, or resume its build.

    The arguments are the options of the command `tableverse build`, and the result has the same bytes. An interrupt
    (`KeyboardInterrupt`) keeps all finished scenes: call it again with the same arguments to resume.

    Args:
        manifest: The image manifest (Parquet), a path or URI. None adds trajectories to a finished dataset, whose
            configuration stays as it was except for overrides of the section `trajectories`.
        out: Folder or URI of the dataset.
        config: YAML file with the keys that differ from the defaults.
        overrides: Keys of the configuration and their values, e.g. `{"run.seed": 7}` or `["run.seed=7"]`.
        executor: `local` for one process, `ray` for as many workers as there are CPUs.
        workers: CPUs that the actors of the build hold together on Ray; None for all.
        address: `HOST:PORT` of a running Ray cluster, or `auto`; None for Ray on this machine.
        pools: YAML file with the resources of each pool of actors.
        stages: `+trajectories` to end with trajectories proven in simulation.
        from_stage: First stage to compute again, for all scenes, e.g. `settle`.
        limit: Most scenes of this run.
        shards: Shards of this run, e.g. `3-7,9` or `{3, 4}`.
        max_usd: Most that the models may cost, over all runs of `out` [USD].
        max_calls: Most requests to models, over all runs of `out`.
        keep: Whether the output of every stage is kept in `out`; `from_stage` needs it.
        display: Shows the progress: `auto` draws a table in a notebook or terminal, None shows nothing.
        signals: Handlers of SIGINT and SIGTERM that end the run; None leaves signals alone.

    Returns:
        The counts of this run. `summary.read_state()` reads those of the whole dataset, with the reasons of losses;
        a new build that was stopped while its executor started has none.

    Raises:
        TableverseError: if the build cannot go on; the message says what to change. Failed scenes raise nothing: they
            are rows of the dataset.

    Example:
        >>> from tableverse_factory.sources.manifest import create_manifest
        >>> from workers import build
        >>> create_manifest(["captures"], "images.parquet")
        >>> summary = build("images.parquet", "out", overrides={"run.seed": 7})
        >>> state = summary.read_state()
        >>> state.done, state.dropped, state.failed
    """
    _check_arguments(executor, workers, limit, max_usd, max_calls)
    place = parse_path(os.fspath(out))
    pipeline = WITH_TRAJECTORIES if manifest is None else _choose_pipeline(stages, from_stage)
    if executor == "ray" and address not in (None, "auto"):
        parse_host_port(str(address))
    _check_parents(place)
    if manifest is None:
        settings = config_from_run(read_run(place / "run.json"), TRAJECTORIES, _format_overrides(overrides))
    else:
        settings = load_config(None if config is None else Path(config), _format_overrides(overrides))
    if pipeline == WITH_TRAJECTORIES:
        # Imports MuJoCo and the planners, which other builds do not need in this process.
        from tableverse_factory.stages.trajectories.preflight import check_trajectory_models

        check_trajectory_models(settings.trajectories, here=executor == "local" or address is None)
    request = BuildRequest(
        manifest=None if manifest is None else parse_path(os.fspath(manifest)),
        out=place,
        config=settings,
        cache_dir=get_cache_dir(),
        executor=executor,
        workers=workers,
        address=address,
        pools=load_pools(None if pools is None else Path(pools), settings),
        from_stage=from_stage,
        limit=limit,
        shards=parse_shards(shards) if isinstance(shards, str) else shards,
        limits=_make_spending_limits(settings, max_usd, max_calls),
        keep=keep,
        pipeline=pipeline,
    )
    with open_display(display) as shown:
        return run_build(request, shown, signals)


def _check_arguments(
    executor: str, workers: int | None, limit: int | None, max_usd: float | None, max_calls: int | None
) -> None:
    """Refuse what the options of the command would refuse."""
    if executor not in (names := get_args(ExecutorName)):
        raise ConfigError(f"executor {sanitize_line(repr(executor), 80)}: give {' or '.join(names)}")
    for name, value, least in (
        ("workers", workers, 1),
        ("limit", limit, 1),
        ("max_usd", max_usd, 0),
        ("max_calls", max_calls, 0),
    ):
        if value is not None and value < least:
            raise ConfigError(f"{name} {value}: give {least} or more, or None for no bound")


def _format_overrides(overrides: Mapping[str, object] | Sequence[str]) -> list[str]:
    """Format overrides as those of the command, whose values are YAML: a text is quoted, so it stays a text."""
    if isinstance(overrides, Mapping):
        texts = {key: json.dumps(value, ensure_ascii=False, default=os.fspath) for key, value in overrides.items()}
        return [f"{key}={text}" for key, text in texts.items()]
    return list(overrides)


def _make_spending_limits(config: Config, max_usd: float | None, max_calls: int | None) -> SpendingLimits:
    if max_usd is not None and not math.isfinite(max_usd):
        raise ConfigError(f"--max-usd {max_usd}: give an amount of money")
    for stage in MODEL_ROLE_BY_STAGE if max_usd is not None else ():
        section: RemoteModelSection = getattr(config, stage)
        if section.protocol and not (section.usd_per_million_input or section.usd_per_million_output):
            raise ConfigError(
                f"--max-usd needs the price of {section.model}: set {stage}.usd_per_million_input and "
                f"{stage}.usd_per_million_output, or give --max-calls"
            )
    return SpendingLimits(max_calls, max_usd)


def _choose_pipeline(stages: str | None, from_stage: str | None) -> str:
    """Choose the pipelines; `from_stage` of the stage that can be added implies that stage."""
    known = [name for name in Config.model_fields if isinstance(getattr(Config(), name), StageSection)]
    if from_stage is not None and from_stage not in known:
        near = difflib.get_close_matches(from_stage, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
        raise ConfigError(f"--from {from_stage[:80]!r}: no such stage; {hint}")
    if stages not in (None, ADDED_STAGES):
        raise ConfigError(f"--stages {str(stages)[:80]!r}: give {ADDED_STAGES}, or leave it out for the usual stages")
    return WITH_TRAJECTORIES if stages == ADDED_STAGES or from_stage == TRAJECTORIES else PIPELINE


def _check_parents(out: StoragePath) -> None:
    if isinstance(out, Path) and (file := next((parent for parent in out.parents if parent.is_file()), None)):
        raise InputError(f"{file} is a file: give another OUT")
