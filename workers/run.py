"""A build from its manifest to its dataset, or from where the last run stopped."""

import os
import signal
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import dropwhile
from pathlib import Path
from typing import Any, Literal

from schemas.config import Config, RemoteModelSection
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import ModelCost
from schemas.pools import Pools
from schemas.work import SandboxSetup
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, read_whole, remove_folder, write_atomic
from tableverse_factory.dataset.card import make_dataset_card
from tableverse_factory.dataset.consolidated_tables import remove_merged_tables, write_merged_tables
from tableverse_factory.dataset.journals import WORK
from tableverse_factory.dataset.model_costs import MODEL_ROLE_BY_STAGE
from tableverse_factory.dataset.shard_plan import Plan, check_shards, read_plan
from tableverse_factory.models.local.recorded_weights import pin_commits
from tableverse_factory.rebuild import MANIFEST_STAGE, manifest_from_dataset
from tableverse_factory.run_record import collect_external_inputs, read_run
from tableverse_factory.stage import Pipelines, post_export_stages
from workers.driver.budget import NO_LIMITS, Budget, SpendingLimits, resume_budget
from workers.driver.driver import Driver
from workers.driver.in_flight import BuildSpec
from workers.driver.signals import StoppedError, StopSignals
from workers.executors.local_executor import LocalExecutor
from workers.executors.protocol import Executor
from workers.plan.read_manifest import read_manifest
from workers.plan.start import check_output_dir, compute_stage_fingerprints, start_or_resume
from workers.progress.build_state import BuildState, read_build_state
from workers.progress.prometheus import dataset_name
from workers.progress.tally import Display, DisplayGroup, Tally
from workers.sandbox.child import load_pipelines
from workers.state.checkpoint_store import CHECKPOINTS
from workers.state.commit import publish_ready
from workers.state.cost_log import sum_costs_by_grant
from workers.state.ledger import Ledger
from workers.state.lock import LOCK, create_writer_lock

PIPELINE = "tableverse_factory.pipeline:PIPELINES"
WITH_TRAJECTORIES = "tableverse_factory.pipeline:WITH_TRAJECTORIES"
ExecutorName = Literal["local", "ray"]


@dataclass(frozen=True, slots=True)
class BuildRequest:
    """Request of a build. The same request, repeated before the build is complete, resumes it."""

    manifest: StoragePath | None  # Parquet; None to add stages to a finished dataset, which gives the rows
    out: StoragePath  # folder of the dataset
    config: Config
    cache_dir: Path
    executor: ExecutorName = "local"
    workers: int | None = None  # CPUs that actors hold together with `ray`; None for all
    address: str | None = None  # a running Ray cluster; None for one on this machine that ends with the build
    pools: Pools = field(default_factory=Pools)  # resources of the actors of each pool, with `ray`
    from_stage: str | None = None  # section of the first stage to compute again; None to resume
    limit: int | None = None  # most scenes of this run; None for all
    shards: Collection[int] | None = None  # shards of this run; None for all
    limits: SpendingLimits = NO_LIMITS  # of all runs together; they never decide the bytes
    keep: bool = True  # whether the output of every stage stays in OUT when its shard is committed
    pipeline: str = PIPELINE  # where the pipelines are, as `module:attribute`


@dataclass(frozen=True, slots=True)
class BuildSummary:
    """Result of one run of a build."""

    out: StoragePath
    tally: Tally  # of this run
    signal: int = 0  # number of the signal that stopped it; 0 otherwise
    over_budget: ModelCost | None = None  # what all runs spent, if that stopped it

    def read_state(self) -> BuildState:
        """Read the outcomes and costs of all scenes of the dataset, those of earlier runs included."""
        return read_build_state(self.out)

    def __str__(self) -> str:
        tally = self.tally
        ended = ", ".join(f"{tally.count(status)} {status}" for status in ("done", "dropped", "failed"))
        return f"{self.out}: {tally.accounted} of {tally.total} scenes accounted for; in this run {ended}"


def run_build(request: BuildRequest, display: Display, signals: StopSignals | None = None) -> BuildSummary:
    """Build the dataset, or resume it; finished scenes survive every stop.

    `signals` stops the run at SIGINT or SIGTERM, which then returns; without it Ctrl-C raises `KeyboardInterrupt`.
    """
    _check_workers(request)
    given = _read_rows(request)
    pipelines = load_pipelines(request.pipeline)
    check_output_dir(request.out)
    _check_models(request, given or (), pipelines)
    with ExitStack() as stack:
        lock = stack.enter_context(create_writer_lock(request.out / WORK / LOCK, display.note))
        if signals is not None:
            stack.enter_context(signals)
        if given is None:
            rows, recorded, base = _restore_from_dataset(request, lock.check)
        else:
            run = request.out / "run.json"
            before = read_run(run) if run.exists() else None
            rows, recorded, base = given, collect_external_inputs(request.config, before), None
        plan, record_build = start_or_resume(
            request.out, rows, pipelines, request.config, recorded, request.from_stage, lock.check, base
        )
        added = post_export_stages(pipelines)
        ledger = stack.enter_context(closing(Ledger(request.out, plan, lock.check, added, request.keep)))
        for line in ledger.damaged:
            display.note(line)
        todo = ledger.todo()
        spec = _make_spec(request, rows, plan, pipelines, recorded, _select_ranks(request, plan, todo))
        tally = _make_tally(plan, pipelines, len(todo), len(spec.todo))
        budget = resume_budget(request.limits, sum_costs_by_grant(request.out))
        over = False
        try:
            if spec.todo:
                remove_merged_tables(request.out)
                over = _run_driver(request, spec, ledger, budget, tally, display, signals, record_build)
            else:
                record_build()
        except StoppedError as stopped:
            return BuildSummary(request.out, tally, stopped.number)
        finally:
            tally.committed, tally.bytes_committed = ledger.committed, ledger.bytes_committed
            tally.queued, tally.running = Counter(), Counter()
            display.show(tally)
        if ledger.committed == plan.n_shards:
            ledger.close()
            _finish_dataset(request.out, plan)
    return BuildSummary(request.out, tally, 0, budget.spent if over else None)


def _check_workers(request: BuildRequest) -> None:
    """Refuse more workers than this machine can hold before anything starts; a cluster is asked once it is joined."""
    workers, cpus = request.workers, os.cpu_count() or 1
    if request.executor == "local" and workers not in (None, 1):
        raise BuildError(f"--executor local has one worker, not {workers}: give --executor ray for more")
    if request.executor == "ray" and request.address is None and (workers or 0) > cpus:
        raise BuildError(f"{workers} workers need {workers} CPUs and this machine has {cpus}: give --workers {cpus}")


def _read_rows(request: BuildRequest) -> Sequence[ImageRow] | None:
    if request.manifest is None:
        return None
    rows = read_manifest(request.manifest)
    check_shards(request.shards, len(rows), request.config.run.shard_size)
    return rows


def _check_models(request: BuildRequest, rows: Sequence[ImageRow], pipelines: Pipelines) -> None:
    """Check what the stages load, before anything is written; a build that goes on may have no more use for it."""
    first = request.from_stage
    if first is None and (request.out / "run.json").exists():
        return
    kinds = {row.kind for row in rows if not row.rejected}
    here = request.executor == "local" or request.address is None
    lines = (dropwhile(lambda stage: first not in (None, stage.section), pipelines[kind]) for kind in kinds)
    for check in dict.fromkeys(stage.check for line in lines for stage in line):
        if check is not None:
            check(request.config, kinds, here)


def _restore_from_dataset(
    request: BuildRequest, guard: Callable[[], None]
) -> tuple[Sequence[ImageRow], dict[str, Any], dict[str, Any]]:
    """Restore the manifest's rows, the recorded inputs and run.json of a finished dataset.

    Shards that a kill left unpublished are published first: one that is half in place does not count as committed.
    """
    out, base = request.out, read_run(request.out / "run.json")
    publish_ready(out, guard)
    plan = read_plan(out / "plan.parquet")
    check_shards(request.shards, plan.n_shards, 1)
    recorded = collect_external_inputs(request.config, base=base)
    return manifest_from_dataset(out, base, plan), recorded, base


def _select_ranks(request: BuildRequest, plan: Plan, todo: Sequence[int]) -> Sequence[int]:
    selected = [rank for rank in todo if request.shards is None or plan.shards[rank] in request.shards]
    return selected[: request.limit]


def _make_spec(
    request: BuildRequest,
    rows: Sequence[ImageRow],
    plan: Plan,
    pipelines: Pipelines,
    recorded: Mapping[str, Any],
    todo: Sequence[int],
) -> BuildSpec:
    return BuildSpec(
        rows=rows,
        kinds=[SceneKind(kind) for kind in plan.kinds.find_distinct()],
        shards=plan.shards,
        pipelines=pipelines,
        config=pin_commits(request.config, recorded),
        fingerprints={
            kind: compute_stage_fingerprints(pipelines, kind, request.config, recorded) for kind in pipelines
        },
        records_dir=request.out / CHECKPOINTS,
        todo=todo,
        added_only=request.manifest is None,
    )


def _make_tally(plan: Plan, pipelines: Pipelines, n_left: int, n_selected: int) -> Tally:
    kinds = [kind for kind in SceneKind if kind.value in plan.kinds]
    stages = dict.fromkeys(stage.name for kind in kinds for stage in pipelines[kind])
    total = len(plan.scene_ids)
    before = total - n_left
    return Tally((MANIFEST_STAGE, *stages), total, before, plan.n_shards, target=before + n_selected)


def _run_driver(
    request: BuildRequest,
    spec: BuildSpec,
    ledger: Ledger,
    budget: Budget,
    tally: Tally,
    display: Display,
    signals: StopSignals | None,
    record_build: Callable[[], None],
) -> bool:
    """Run the scenes, once the build is recorded; returns whether the budget stopped the run."""

    def check() -> None:
        if signals is not None:
            signals.check()
        ledger.tick()

    def watch() -> None:
        check()
        display.show(tally)

    _note_missing_keys(request, display)
    if request.executor == "ray":
        display.note(f"joining Ray at {request.address} …" if request.address else "starting Ray on this machine …")
    try:
        made = _make_executor(request, spec, watch)
    except SystemExit as error:  # by Ray's own handler of SIGTERM, which it installs before it starts
        if signals is None or error.code != signal.SIGTERM:
            raise
        raise StoppedError(signal.SIGTERM) from error
    with closing(made) as executor:
        if signals is not None:
            signals.install()  # again, because `ray.init` takes SIGTERM for itself
        record_build()
        if request.executor == "ray":
            from workers.progress.ray_metrics import RayMetrics

            display = DisplayGroup(display, RayMetrics(dataset_name(request.out)))
        driver = Driver(spec, ledger, executor, budget, tally, display)
        driver.run(check)
    return driver.out_of_budget


def _note_missing_keys(request: BuildRequest, display: Display) -> None:
    for stage, role in MODEL_ROLE_BY_STAGE.items() if request.manifest is not None else ():
        section: RemoteModelSection = getattr(request.config, stage)
        if section.protocol and section.key_env and not os.environ.get(section.key_env):
            display.note(f"{section.key_env} is not set here: the {role} can only repeat cached answers")


def _make_executor(request: BuildRequest, spec: BuildSpec, watch: Callable[[], None]) -> Executor:
    run, out = request.config.run, request.out.absolute()  # actors have a working folder of their own
    setup = SandboxSetup(
        pipeline=request.pipeline,
        config_json=spec.config.model_dump_json(),
        cache_dir=str(request.cache_dir),
        attempts=run.attempts,
        memory_mb=run.memory_mb,
        records_dir=str(out / CHECKPOINTS),
    )
    if request.executor == "local":
        return LocalExecutor(setup, watch)
    from workers.executors.preflight import sample_inputs
    from workers.executors.ray_executor import ClusterSpec, RayExecutor  # importing ray takes a second

    inputs = [] if request.manifest is None else [row.uri for row in sample_inputs(spec.rows)]  # or the dataset alone
    return RayExecutor(setup, request.pools, ClusterSpec(request.address, request.workers, inputs, out / WORK))


def _finish_dataset(out: StoragePath, plan: Plan) -> None:
    """Write the card and merged tables and remove the work folder; a second build changes nothing."""
    card = make_dataset_card(out, read_run(out / "run.json"), range(plan.n_shards)).encode()
    path = out / "README.md"
    if not path.exists() or read_whole(path) != card:
        write_atomic(path, card)
    write_merged_tables(out, plan.n_shards)
    remove_folder(out / WORK, keep=LOCK)
