"""In-memory executor that plays a script, and the parts of a build around a driver: no process, no Ray, no shards."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Dropped, Failed, ModelCost
from schemas.work import CommitCall, ScenePart, SceneResult, StageChainReport, StagedShard, StageReport
from tableverse_factory.stage import Stage
from tests.helpers.builds import Silent
from workers.driver.budget import NO_LIMITS, Budget, SpendingLimits, resume_budget
from workers.driver.driver import Driver
from workers.driver.in_flight import BuildSpec
from workers.executors.protocol import CallFinished, Event, Job, JobResult, ShardStaged, WorkerLost, WorkerReady
from workers.executors.schedule import PoolLimits, ScheduleLimits
from workers.progress.tally import Tally
from workers.state.checkpoint_store import CheckpointStore, name_checkpoint

PART = ScenePart("0123.parts", 0, 10, 20)
LOSE_WORKER, LOSE_INPUT, RAISE_IN_WORKER = "lose worker", "lose input", "raise in worker"
Action = Dropped | Failed | ModelCost | str
"""Outcome of a stage; a cost for one that is done; or a loss."""

STAGES = (
    Stage("look", "perception", lambda *_: None, reads=("observe",)),
    Stage("settle", "physics", lambda *_: None, reads=("settle",)),
    Stage("judge", "curation", lambda *_: None, reads=("curate",)),
    Stage("pack", "curation", lambda *_: None, reads=("export",)),
)


def make_rows(n: int, **changes: object) -> list[ImageRow]:
    return [ImageRow(scene_id=f"s{i}", kind="capture", uri=f"/data/{i}", name="n", **changes) for i in range(n)]


def make_spec(
    folder: Path,
    rows: Sequence[ImageRow],
    stages: Sequence[Stage] = STAGES,
    config: Config | None = None,
    *,
    added_only: bool = False,
) -> BuildSpec:
    return BuildSpec(
        rows=rows,
        kinds=[SceneKind.CAPTURE],
        shards=[0] * len(rows),
        pipelines={SceneKind.CAPTURE: stages},
        config=config or Config(),
        fingerprints={SceneKind.CAPTURE: {stage.name: "f" for stage in stages}},
        records_dir=folder / ".stages",
        todo=range(len(rows)),
        added_only=added_only,
    )


class FakeLedger:
    """Results in memory; the only shard is whole when all scenes are recorded."""

    committed = bytes_committed = 0
    damaged = ("1 finished scene does not read",)

    def __init__(self, n_scenes: int) -> None:
        self.n_scenes = n_scenes
        self.results: dict[str, SceneResult] = {}
        self.unreadable: list[list[int]] = []  # scenes whose parts do not read, at each attempt to publish
        self.published = 0

    def record(self, rank: int, result: SceneResult) -> CommitCall | None:
        assert result.scene_id not in self.results, "a scene ends once"
        self.results[result.scene_id] = result
        return CommitCall(0, tuple(self.results), (), "0") if len(self.results) == self.n_scenes else None

    def publish(self, call: CommitCall, staged: StagedShard) -> list[int]:
        if self.unreadable:
            again = self.unreadable.pop(0)
            for rank in again:
                del self.results[f"s{rank}"]
            return again
        self.published += 1
        return []

    def retry(self, call: CommitCall) -> CommitCall:
        return replace(call, token=f"{call.token}1")


class FakeExecutor:
    """Workers that exist by number only; every stage is done unless the script says otherwise.

    Attributes:
        runs: How often each stage ran, by (scene_id, position).
    """

    def __init__(
        self, folder: Path, script: Mapping[tuple[str, int], Sequence[Action]] | None = None, workers: int = 1
    ) -> None:
        self._script = defaultdict(list, {key: list(actions) for key, actions in (script or {}).items()})
        self._store = CheckpointStore(folder / ".stages")
        self._events: list[Event] = []
        self._started = 0
        self.limits = ScheduleLimits({"all": PoolLimits({"CPU": 1.0}, batch=1)}, {"CPU": float(workers)})
        self.runs: Counter[tuple[str, int]] = Counter()

    def pool_of(self, stage_pool: str) -> str:
        return "all"

    def start(self, pool: str) -> int:
        self._started += 1
        self._events.append(WorkerReady(self._started))
        return self._started

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        results = []
        for job in jobs:
            result = self._run(job)
            if isinstance(result, str):
                self._events.append(self._lose(worker, jobs, result))
                return
            results.append(result)
        self._events.append(CallFinished(worker, tuple(results)))

    def wait(self, timeout_s: float) -> list[Event]:
        events, self._events = self._events, []
        return events

    def retire(self, worker: int) -> None:
        pass

    def stage_shard(self, worker: int, call: CommitCall) -> None:
        if self._script["commit", call.shard]:
            self._events.append(self._lose(worker, call, self._script["commit", call.shard].pop(0)))
        else:
            self._events.append(ShardStaged(worker, call, StagedShard(call.token, 0, ())))

    def close(self) -> None:
        pass

    def _lose(self, worker: int, work: tuple[Job, ...] | CommitCall, action: Action) -> WorkerLost:
        raised = {LOSE_WORKER: False, RAISE_IN_WORKER: True}[action]
        return WorkerLost(worker, work, "node n: OSError: no room" if raised else "its node is gone", raised)

    def _run(self, job: Job) -> JobResult | str:
        """Run the stages of a job; LOSE_WORKER or RAISE_IN_WORKER if that happens."""
        reports: list[StageReport] = []
        chain, output = job.chain, ""
        assert bool(chain.input) == bool(chain.position), "the input is a checkpoint or the row"
        for position, call in enumerate(chain.calls, chain.position):
            key = (chain.row.scene_id, position)
            self.runs[key] += 1
            action = self._script[key].pop(0) if self._script[key] else None
            if action in (LOSE_WORKER, RAISE_IN_WORKER):
                return action
            if action == LOSE_INPUT:
                return JobResult(job.rank, StageChainReport(tuple(reports), output, input_lost=True))
            cost = action if isinstance(action, ModelCost) else ModelCost()
            outcome = action if isinstance(action, Dropped | Failed) else None
            attempts = 2 if isinstance(outcome, Failed) and outcome.error_kind == "crash" else 1
            reports.append(StageReport(outcome, attempts, 0.1, 0.2, "trace" if outcome else "", cost, cost))
            if outcome is not None:
                break
            output = PART
            if call.key:
                name = name_checkpoint(chain.shard, chain.row.scene_id, STAGES[position].name, call.key)
                output = self._store.write(name, b"output").name
        return JobResult(job.rank, StageChainReport(tuple(reports), output))


class FakeBuild:
    """A driver on a fake executor, with everything that it writes."""

    def __init__(
        self,
        folder: Path,
        rows: Sequence[ImageRow],
        script: Mapping[tuple[str, int], Sequence[Action]] | None = None,
        limits: SpendingLimits = NO_LIMITS,
        config: Config | None = None,
        workers: int = 1,
        executor: type[FakeExecutor] = FakeExecutor,
    ) -> None:
        self.spec = make_spec(folder, rows, config=config)
        self.ledger = FakeLedger(len(rows))
        self.executor = executor(folder, script, workers)
        self.budget: Budget = resume_budget(limits, {})
        self.tally = Tally(("manifest", *(stage.name for stage in STAGES)), len(rows), 0, 1)
        self.display = Silent()
        self.driver = Driver(self.spec, self.ledger, self.executor, self.budget, self.tally, self.display)

    def run(self, check=lambda: None) -> dict[str, SceneResult]:
        self.driver.run(check)
        return self.ledger.results
