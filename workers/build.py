"""A build from its manifest to its dataset, or from where the last one stopped: checks, lock, work, card."""

import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from schemas.config import AskedSection, Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Spent
from schemas.pools import Pools
from schemas.work import SandboxSetup
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, read_whole, remove_folder, write_atomic
from tableverse_factory.dataset.card import dataset_card
from tableverse_factory.dataset.consolidated_tables import remove_merged, write_merged
from tableverse_factory.dataset.model_costs import MODEL_ROLE_BY_STAGE
from tableverse_factory.dataset.shard_plan import Plan, check_shards, read_plan
from tableverse_factory.rebuild import manifest_from_dataset
from tableverse_factory.run_record import RECORDED_BY, external_inputs, read_run, robot_input, with_commits
from tableverse_factory.stage import Pipelines
from workers.driver.budget import NO_LIMITS, Budget, SpendingLimits, budget_of
from workers.driver.driver import Driver
from workers.driver.job_spec import BuildSpec
from workers.driver.outcomes import MANIFEST_STAGE
from workers.driver.signals import StoppedError, StopSignals
from workers.executors.local_executor import LocalExecutor
from workers.executors.protocol import Executor
from workers.plan.read_manifest import read_manifest
from workers.plan.start import check_output_dir, fingerprints_of, start_or_resume
from workers.progress.prometheus import dataset_name
from workers.progress.tally import Display, Displays, Tally
from workers.sandbox.child import load_pipelines
from workers.state.checkpoint_store import RECORDS
from workers.state.commit import publish_ready
from workers.state.cost_log import spent_by_grant
from workers.state.ledger import WORK, Ledger
from workers.state.lock import LOCK, writer_lock

PIPELINE = "tableverse_factory.pipeline:PIPELINES"
WITH_TRAJECTORIES = "tableverse_factory.pipeline:WITH_TRAJECTORIES"
PARTING_WORDS = "stopped; everything finished is kept: run the same command to go on"


@dataclass(frozen=True, slots=True)
class BuildRequest:
    """What to build, where, and with what.

    Attributes:
        manifest: Image manifest (Parquet); None for a finished dataset to which stages are added: its rows are
            restored from it.
        out: Folder of the dataset; begun here before, the build goes on.
        workers: Calls in flight with `ray`; None for one per CPU.
        address: A running Ray cluster; None for one on this machine that ends with the build.
        pools: What the actors of each pool hold, with `ray`.
        begin_from: Section of the stage from which on everything is computed again; None to go on. Given once more
            before the build is complete, with nothing changed, it goes on too.
        limit: Scenes that this run works on at most; None for all.
        shards: Shards that this run works on; None for all.
        limits: What its questions to models may cost, over all runs: nothing of it decides the bytes.
        keep: Whether the output of every stage stays in OUT when its shard is committed.
        pipeline: Where the lines are, as `module:attribute`.
    """

    manifest: StoragePath | None
    out: StoragePath
    config: Config
    cache_dir: Path
    executor: Literal["local", "ray"] = "local"
    workers: int | None = None
    address: str | None = None
    pools: Pools = field(default_factory=Pools)
    begin_from: str | None = None
    limit: int | None = None
    shards: Collection[int] | None = None
    limits: SpendingLimits = NO_LIMITS
    keep: bool = True
    pipeline: str = PIPELINE


@dataclass(frozen=True, slots=True)
class Summary:
    """How a run of the build ended.

    Attributes:
        tally: The counts of this run.
        signal: Number of the signal that stopped it; 0 where it is complete.
        over_budget: What was spent in all, where that stopped it.
    """

    tally: Tally
    signal: int
    over_budget: Spent | None = None


def run_build(request: BuildRequest, display: Display) -> Summary:
    """Builds the dataset, or goes on with it; afterwards every scene is accounted for, unless a signal stopped it.

    Raises:
        InputError: if the manifest cannot be read.
        ConfigError: if the folder of recorded answers is not there.
        ModelAccessError: if nobody can say which commit of weights on the hub is meant.
        BuildError: if OUT holds another build or is being written, if the disk refuses, or workers cannot start.
    """
    if request.executor == "local" and request.workers not in (None, 1):
        raise BuildError(f"--executor local has one worker, not {request.workers}: give --executor ray for more")
    given = _given(request)
    lines = load_pipelines(request.pipeline)
    check_output_dir(request.out)
    with writer_lock(request.out / WORK / LOCK, display.note) as lock, StopSignals(PARTING_WORDS) as signals:
        rows, recorded, base = _restored(request, lock.check) if given is None else (given, _recorded(request), None)
        plan = start_or_resume(request.out, rows, lines, request.config, recorded, request.begin_from, lock.check, base)
        with closing(Ledger(request.out, plan, rows, lock.check)) as ledger:
            for line in ledger.damaged:
                display.note(line)
            tally = _tally(plan, lines, ledger)
            todo = _chosen(request, plan, ledger.todo())
            tally.aim = tally.before + len(todo)
            budget = budget_of(request.limits, spent_by_grant(request.out))
            work = _work(request, rows, lines, recorded, todo)
            over = False
            try:
                if todo:
                    remove_merged(request.out)
                    over = _drive(request, work, ledger, budget, tally, display, signals)
            except StoppedError as stopped:
                return Summary(tally, stopped.number)
            finally:
                tally.committed, tally.bytes_committed = ledger.committed, ledger.bytes_committed
                tally.queued, tally.running = Counter(), Counter()
                display.show(tally)
            complete = not ledger.todo()
        if complete:
            _finish(request.out, plan)
    return Summary(tally, 0, budget.spent if over else None)


def _given(request: BuildRequest) -> list[ImageRow] | None:
    """Rows of the manifest, where there is one."""
    if request.manifest is None:
        return None
    rows = read_manifest(request.manifest)
    check_shards(request.shards, len(rows), request.config.run.shard_size)
    return rows


def _recorded(request: BuildRequest) -> dict[str, Any]:
    """What the build reads besides its manifest, as it was when it began."""
    run = request.out / "run.json"
    return external_inputs(request.config, read_run(run) if run.exists() else None)


def _restored(
    request: BuildRequest, guard: Callable[[], None]
) -> tuple[list[ImageRow], dict[str, Any], dict[str, Any]]:
    """Rows of the manifest, recorded inputs and run.json of a finished dataset.

    What a kill left to be published comes first: a shard that is half in its place does not count as committed.
    """
    out, base = request.out, read_run(request.out / "run.json")
    publish_ready(out, out / WORK, guard)
    plan = read_plan(out / "plan.parquet")
    check_shards(request.shards, plan.n_shards, 1)
    recorded = {name: base[name] for name in RECORDED_BY if name in base and name != "robot"} | robot_input(
        request.config
    )
    return manifest_from_dataset(out, base, plan), recorded, base


def _chosen(request: BuildRequest, plan: Plan, todo: Sequence[int]) -> Sequence[int]:
    """What this run works on."""
    chosen = [rank for rank in todo if request.shards is None or plan.shards[rank] in request.shards]
    return chosen[: request.limit]


def _work(
    request: BuildRequest, rows: Sequence[ImageRow], lines: Pipelines, recorded: Mapping[str, Any], todo: Sequence[int]
) -> BuildSpec:
    return BuildSpec(
        rows=rows,
        lines=lines,
        config=with_commits(request.config, recorded),
        fingerprints={kind: fingerprints_of(lines, kind, request.config, recorded) for kind in lines},
        records_dir=request.out / RECORDS,
        keep=request.keep,
        todo=todo,
        added_only=request.manifest is None,
    )


def _drive(
    request: BuildRequest,
    work: BuildSpec,
    ledger: Ledger,
    budget: Budget,
    tally: Tally,
    display: Display,
    signals: StopSignals,
) -> bool:
    """Does the work; whether the budget ended it before its end."""

    def check() -> None:
        signals.check()
        ledger.tick()

    def watch() -> None:
        check()
        display.show(tally)

    for stage, asker in MODEL_ROLE_BY_STAGE.items() if request.manifest is not None else ():
        section: AskedSection = getattr(request.config, stage)
        if section.asked and section.key_env and not os.environ.get(section.key_env):
            display.note(f"{section.key_env} is not set here: the {asker} can only repeat answers that were kept")
    if request.executor == "ray":
        display.note(f"joining Ray at {request.address} …" if request.address else "starting Ray on this machine …")
    with closing(_executor(request, work, watch)) as executor:
        signals.install()
        if request.executor == "ray":
            from workers.progress.ray_metrics import RayMetrics

            display = Displays(display, RayMetrics(dataset_name(request.out)))
        driver = Driver(work, ledger, executor, budget, tally, display)
        driver.run(check)
    return driver.out_of_budget


def _executor(request: BuildRequest, work: BuildSpec, watch: Callable[[], None]) -> Executor:
    run, out = request.config.run, request.out.absolute()  # actors have a working folder of their own
    setup = SandboxSetup(
        pipeline=request.pipeline,
        config_json=work.config.model_dump_json(),
        cache_dir=str(request.cache_dir),
        attempts=run.attempts,
        memory_mb=run.memory_mb,
        records_dir=str(out / RECORDS),
    )
    if request.executor == "local":
        return LocalExecutor(setup, watch)
    from workers.executors.ray_executor import (  # importing ray takes a second that `local` need not pay
        ClusterSpec,
        RayExecutor,
    )

    inputs = [] if request.manifest is None else [row.uri for row in work.rows]  # what is at rest is read instead
    return RayExecutor(setup, request.pools, ClusterSpec(request.address, request.workers, inputs, out / WORK))


def _tally(plan: Plan, lines: Pipelines, ledger: Ledger) -> Tally:
    kinds = [kind for kind in SceneKind if kind.value in plan.kinds]
    stages = dict.fromkeys(stage.name for kind in kinds for stage in lines[kind])
    todo = len(ledger.todo())
    return Tally((MANIFEST_STAGE, *stages), len(plan.scene_ids), len(plan.scene_ids) - todo, plan.n_shards)


def _finish(out: StoragePath, plan: Plan) -> None:
    """Writes the card and merged tables, clears away the work; a second build has nothing to do and changes nothing."""
    card = dataset_card(out, read_run(out / "run.json"), range(plan.n_shards)).encode()
    path = out / "README.md"
    if not path.exists() or read_whole(path) != card:
        write_atomic(path, card)
    write_merged(out, plan.n_shards)
    remove_folder(out / WORK, besides=LOCK)
