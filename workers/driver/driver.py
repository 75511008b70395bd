"""The event loop that takes every scene through its stages: admit, dispatch, wait, record."""

from collections import Counter
from collections.abc import Callable, Sequence

from schemas.outcome import NO_COST, UNLIMITED, Failed
from schemas.work import CommitCall, ScenePart, StageCall, StageChain, StagedShard, StageTiming
from tableverse_factory.core.errors import BudgetSpentError, BuildError
from tableverse_factory.stage import Stage
from workers.driver.budget import Budget, calls_model
from workers.driver.checkpoints import CheckpointIndex
from workers.driver.in_flight import BuildSpec, InFlightScene
from workers.driver.outcomes import OutcomeRecorder
from workers.driver.worker_manager import WorkerManager
from workers.executors.protocol import (
    CallFinished,
    Event,
    Executor,
    Job,
    JobResult,
    ShardStaged,
    WorkerLost,
)
from workers.executors.schedule import ReadyScene
from workers.progress.tally import Actors, Display, Tally
from workers.state.checkpoint_store import parse_key
from workers.state.cost_log import sum_costs_by_grant
from workers.state.ledger import Ledger

MAX_LOSSES_PER_SCENE = 5
MAX_LOSSES_PER_CALL = 10  # in a row, per call in flight: one machine that is lost takes many calls along
MAX_ERRORS_PER_CALL = 3  # as above, of workers that raise: every call of a machine meets its full disk
_BUDGET_SPENT = BudgetSpentError.__name__
_WAIT_S = 0.2


class Driver:
    """Scheduler of the scenes that the ledger lacks."""

    def __init__(
        self, spec: BuildSpec, ledger: Ledger, executor: Executor, budget: Budget, tally: Tally, display: Display
    ) -> None:
        self._spec, self._ledger, self._executor = spec, ledger, executor
        self._budget, self._tally, self._display = budget, tally, display
        self._checkpoints = CheckpointIndex(spec)
        self._outcomes = OutcomeRecorder(ledger, tally, display)
        self._commits_in_flight = 0
        self._todo = [*spec.todo][::-1]
        self._waiting: dict[int, InFlightScene] = {}
        self._running: dict[int, InFlightScene] = {}
        stages = [stage for kind in spec.kinds for stage in spec.pipelines[kind]]
        self._asking = {stage.name for stage in stages if calls_model(stage, spec.config)}
        self._workers = WorkerManager(executor, sorted({executor.pool_of(stage.pool) for stage in stages}))
        self._losses_in_a_row = self._errors_in_a_row = 0  # of workers that died and that raised, since the last result
        self._older: set[int] = set()  # scenes that have run since before the errors in a row began
        self.out_of_budget = False  # whether a scene waits for a budget that is spent

    def run(self, check: Callable[[], None]) -> None:
        """Run until every scene is accounted for or postponed, or the budget is spent.

        When the budget is spent, scenes that need no more questions are finished first. `check` is called several times
        a second and ends the loop by raising.
        """
        while self._todo or self._waiting or self._is_busy():
            check()
            if not self.out_of_budget:
                self._admit()
            self._assign()
            self._update_tally()
            if self.out_of_budget and not (self._is_busy() or self._list_ready()):
                return
            for event in self._executor.wait(_WAIT_S):
                self._on_event(event)
        self._update_tally()

    def _is_busy(self) -> bool:
        """Whether scenes run, or shards are to be committed."""
        return bool(self._running or self._outcomes.commits or self._commits_in_flight)

    def _admit(self) -> None:
        room = self._workers.max_in_flight - len(self._waiting) - len(self._running)
        while room > 0 and self._todo:
            rank = self._todo.pop()
            row = self._spec.rows[rank]
            if row.rejected:
                self._outcomes.record_rejected(rank, row)
                continue
            self._waiting[rank] = self._checkpoints.start(rank)
            room -= 1

    def _assign(self) -> None:
        waiting = len(self._outcomes.commits)
        self._workers.dispatch_commits(self._outcomes.commits)
        self._commits_in_flight += waiting - len(self._outcomes.commits)
        for rank in self._workers.dispatch(self._list_ready(), self._make_job):
            self._running[rank] = self._waiting.pop(rank)

    def _list_ready(self) -> list[ReadyScene]:
        """List the scenes that may continue; of those that call a model only as many as the budget allows."""
        room = 0 if self.out_of_budget else self._budget.room
        ready = []
        for rank, scene in self._waiting.items():
            if self._calls_model(scene):
                if room <= 0:
                    continue
                room -= 1
            left = len(scene.stages) - scene.position
            ready.append(ReadyScene(rank, self._get_pool(scene.stage), left, alone=scene.losses > 0))
        return ready

    def _calls_model(self, scene: InFlightScene) -> bool:
        stages = scene.stages[scene.position : self._find_end(scene)] if self._asking else ()
        return any(stage.name in self._asking for stage in stages)

    def _find_end(self, scene: InFlightScene) -> int:
        """Find the end of the scene's next stages that the same pool runs."""
        pool, stop = self._get_pool(scene.stage), scene.position + 1
        while stop < len(scene.stages) and self._get_pool(scene.stages[stop]) == pool:
            stop += 1
        return stop

    def _make_job(self, rank: int) -> Job:
        scene = self._waiting[rank]
        stop = self._find_end(scene)
        allowance = self._budget.grant(rank) if self._calls_model(scene) else UNLIMITED
        calls = tuple(
            StageCall(
                self._spec.config.get_deadline(scene.stages[position].section),
                parse_key(scene.records[position]),
                scene.tried[position],
            )
            for position in range(scene.position, stop)
        )
        chain = StageChain(
            scene.row,
            scene.shard,
            scene.position,
            calls,
            scene.input,
            allowance,
            losses=scene.child_losses,
            failure=scene.failure,
            new_child=scene.new_child,
        )
        return Job(rank, chain)

    def _get_pool(self, stage: Stage) -> str:
        return self._executor.pool_of(stage.pool)

    def _on_event(self, event: Event) -> None:
        self._workers.on_event(event)
        match event:
            case WorkerLost(work=CommitCall() as call):
                self._count_loss(event)
                self._commits_in_flight -= 1
                self._outcomes.commits.append(self._ledger.retry(call))
            case WorkerLost(work=tuple(jobs), raised=raised):
                self._count_loss(event)
                ranks = [job.rank for job in jobs]
                self._settle_from_log(ranks)
                self._requeue([self._running.pop(rank) for rank in ranks], counts=not raised)
            case ShardStaged(call=call, staged=staged):
                self._losses_in_a_row = self._errors_in_a_row = 0
                self._commits_in_flight -= 1
                self._publish(call, staged)
            case CallFinished(answers=answers):
                self._losses_in_a_row = self._errors_in_a_row = 0
                self._settle_answers(answers)
                for answer in answers:
                    self._advance(self._running.pop(answer.rank), answer)

    def _publish(self, call: CommitCall, staged: StagedShard) -> None:
        again = self._ledger.publish(call, staged)
        if again:
            scenes = [self._checkpoints.start(rank) for rank in again]
            self._checkpoints.resume(scenes)
            self._waiting |= {scene.rank: scene for scene in scenes}
            self._tally.before -= len(again)  # they were accounted for, in this run or before
            self._display.note(self._ledger.damaged[-1])

    def _settle_answers(self, answers: Sequence[JobResult]) -> None:
        """Settle the spending of finished jobs."""
        self._settle_from_log([answer.rank for answer in answers if not answer.report.counted])
        for answer in answers:
            if answer.rank in self._budget.granted:
                stages = answer.report.stages
                paid = sum((report.paid for report in stages), NO_COST)
                cost = sum((report.cost for report in stages if report.outcome is None), NO_COST)
                self._budget.settle(answer.rank, paid, cost)

    def _settle_from_log(self, ranks: Sequence[int]) -> None:
        """Settle scenes from the cost log, because the process that spent is gone."""
        granted = [rank for rank in ranks if rank in self._budget.granted]
        logged = sum_costs_by_grant(self._spec.records_dir.parent) if granted else {}
        for rank in granted:
            self._budget.settle(rank, logged.get(self._budget.granted[rank].name, NO_COST))

    def _advance(self, scene: InFlightScene, answer: JobResult) -> None:
        if answer.report.input_lost:
            self._requeue([scene])
            return
        first_position = scene.position
        output, scene.new_child = answer.report.output, False
        for report in answer.report.stages:
            stage = scene.stage
            if scene.position > first_position:
                scene.input = str(output)
            if isinstance(report.outcome, Failed) and report.outcome.error_kind == _BUDGET_SPENT:
                scene.tried[scene.position], scene.child_losses = report.attempts - 1, answer.report.losses
                scene.new_child = answer.report.new_child
                self.out_of_budget = self._budget.is_spent
                self._waiting[scene.rank] = scene
                return
            if report.cost:
                scene.costs[stage.name] = report.cost
            scene.attempts = max(scene.attempts, report.attempts)
            if scene.failure is None:
                scene.timings.append(StageTiming(stage.name, report.cpu_s, report.wall_s))
            self._tally.record_call(stage.name, report.cpu_s, report.wall_s)
            if report.outcome is not None:
                if not self._outcomes.record_unfinished(scene, report):
                    self._waiting[scene.rank] = scene
                return
            if scene.position + 1 == len(scene.stages) and isinstance(output, ScenePart):
                self._outcomes.record_done(scene, output)
                return
            self._tally.passed[stage.name] += 1
            scene.position += 1
        scene.input = str(output)
        self._waiting[scene.rank] = scene

    def _count_loss(self, lost: WorkerLost) -> None:
        """Count a lost worker; raise if only losses came since the last result.

        A machine whose workers raise at once is given all that is to do: what others have begun before is awaited.
        """
        self._tally.losses += 1
        ended = {job.rank for job in lost.work} if isinstance(lost.work, tuple) else set()
        if lost.raised:
            self._older = (self._older if self._errors_in_a_row else set(self._running)) - ended
            self._errors_in_a_row += 1
        else:
            self._older -= ended
            self._losses_in_a_row += 1
        calls = self._workers.max_calls_in_flight
        if self._losses_in_a_row >= MAX_LOSSES_PER_CALL * calls:
            what = f"{self._losses_in_a_row} workers were lost"
        elif self._errors_in_a_row >= MAX_ERRORS_PER_CALL * calls and not self._older:
            what = f"{self._errors_in_a_row} workers raised errors"
        else:
            return
        raise BuildError(
            f"{what} in a row, the last one with: {lost.why}. Finished scenes are kept: see to the cluster, then run "
            "the same command to go on"
        )

    def _requeue(self, scenes: Sequence[InFlightScene], *, counts: bool = True) -> None:
        """Requeue scenes whose worker or input is lost; one that loses them too often fails, if that counts."""
        requeued = []
        for scene in scenes:
            scene.losses += counts
            if not counts or scene.losses < MAX_LOSSES_PER_SCENE or not self._outcomes.record_lost(scene):
                requeued.append(scene)
        self._checkpoints.resume(requeued)
        self._waiting |= {scene.rank: scene for scene in requeued}

    def _update_tally(self) -> None:
        self._tally.queued = Counter(scene.stage.name for scene in self._waiting.values())
        self._tally.running = Counter(scene.stage.name for scene in self._running.values())
        alive = self._workers.alive
        self._tally.actors = {pool: Actors(alive[pool], size) for pool, size in self._workers.sizes.items()}
        self._tally.committed, self._tally.bytes_committed = self._ledger.committed, self._ledger.bytes_committed
        self._tally.restarts = self._workers.restarts
        self._display.show(self._tally)
