"""The loop that takes every scene through its line: it admits, assigns, listens, and says what has ended."""

from collections import Counter
from collections.abc import Callable, Sequence

from schemas.outcome import NOTHING, UNLIMITED, Failed
from schemas.work import StageCall, StageChain, StageTiming
from tableverse_factory.core.errors import BudgetSpentError, BuildError
from tableverse_factory.stage import Stage
from workers.driver.budget import Budget, calls_model
from workers.driver.checkpoints import CheckpointIndex
from workers.driver.in_flight import InFlightScene
from workers.driver.job_spec import BuildSpec
from workers.driver.outcomes import OutcomeRecorder
from workers.driver.worker_manager import WorkerManager
from workers.executors.protocol import Answer, CallFinished, Event, Executor, Job, Payload, PayloadLostError, WorkerLost
from workers.executors.schedule import Ready
from workers.progress.tally import Actors, Display, Tally
from workers.state.cost_log import spent_by_grant
from workers.state.ledger import Ledger

MAX_LOSSES_PER_SCENE = 5
MAX_LOSSES_PER_CALL = 10
"""Losses without any answer between them, times the calls in flight: one machine that goes takes many calls along."""
_OUT_OF_BUDGET = BudgetSpentError.__name__

_WAIT_S = 0.2


class Driver:
    """Runs what the ledger has still to do on an executor.

    Attributes:
        out_of_budget: Whether nothing more may be spent, and a scene waits for it.
    """

    def __init__(
        self, work: BuildSpec, ledger: Ledger, executor: Executor, budget: Budget, tally: Tally, display: Display
    ) -> None:
        self._work, self._ledger, self._executor = work, ledger, executor
        self._budget, self._tally, self._display = budget, tally, display
        self._kept = CheckpointIndex(work, ledger)
        self._endings = OutcomeRecorder(work, ledger, self._kept, tally, display)
        self._todo = [*work.todo][::-1]
        self._waiting: dict[int, InFlightScene] = {}
        self._running: dict[int, InFlightScene] = {}
        kinds = {work.rows[rank].kind for rank in self._todo}
        self._crew = WorkerManager(
            executor, sorted({executor.pool_of(s.pool) for kind in kinds for s in work.lines[kind]})
        )
        self._losses_in_a_row = 0
        self.out_of_budget = False

    def run(self, check: Callable[[], None]) -> None:
        """Works until every scene that is to be done is accounted for, or left for a later run; or the budget is spent.

        Then no further question is begun, and what needs none is finished.

        Args:
            check: Called several times a second; ends the loop by raising.

        Raises:
            BuildError: if the disk refuses, workers die faster than they answer, or a model wants what only a person
                can give.
        """
        while self._todo or self._waiting or self._running:
            check()
            if not self.out_of_budget:
                self._admit()
            self._assign()
            self._show()
            if self.out_of_budget and not self._running and not self._ready():
                return
            for event in self._executor.wait(_WAIT_S):
                self._hear(event)
        self._show()

    def _admit(self) -> None:
        room = self._crew.line - len(self._waiting) - len(self._running)
        while room > 0 and self._todo:
            rank = self._todo.pop()
            row = self._work.rows[rank]
            if row.rejected:
                self._endings.rejected(row)
                continue
            self._waiting[rank] = self._kept.begin(rank)
            room -= 1

    def _assign(self) -> None:
        for rank in self._crew.hand_out(self._ready(), self._job_of):
            self._running[rank] = self._waiting.pop(rank)

    def _ready(self) -> list[Ready]:
        """Scenes that may go on; those that ask a model only as far as the budget has room for them."""
        room = 0 if self.out_of_budget else self._budget.room
        ready = []
        for rank, scene in self._waiting.items():
            if self._asks(scene):
                if room <= 0:
                    continue
                room -= 1
            ready.append(Ready(rank, self._pool_of(scene.stage), len(scene.line) - scene.position, scene.losses > 0))
        return ready

    def _asks(self, scene: InFlightScene) -> bool:
        """Whether one of its next stages asks a model."""
        return any(calls_model(stage, self._work.config) for stage in scene.line[scene.position : self._stop(scene)])

    def _stop(self, scene: InFlightScene) -> int:
        """Where its next stages end: as many as the same pool runs."""
        pool, stop = self._pool_of(scene.stage), scene.position + 1
        while stop < len(scene.line) and self._pool_of(scene.line[stop]) == pool:
            stop += 1
        return stop

    def _job_of(self, rank: int) -> Job:
        """The scene's next stages."""
        scene = self._waiting[rank]
        stop = self._stop(scene)
        allowance = self._budget.grant(rank) if self._asks(scene) else UNLIMITED
        calls = tuple(
            StageCall(
                scene.row.scene_id,
                scene.row.kind.value,
                position,
                self._work.config.deadline_of(scene.line[position].section),
                scene.tried[position],
            )
            for position in range(scene.position, stop)
        )
        chain = StageChain(calls, scene.kept, scene.records[scene.position : stop], allowance, scene.child_losses)
        return Job(rank, chain, scene.payload)

    def _pool_of(self, stage: Stage) -> str:
        return self._executor.pool_of(stage.pool)

    def _hear(self, event: Event) -> None:
        self._crew.hear(event)
        match event:
            case WorkerLost(ranks=ranks, why=why, inputs_lost=inputs_lost):
                self._count_loss(why)
                self._settle_unheard(ranks)
                self._lose([self._running.pop(rank) for rank in ranks], inputs_lost)
            case CallFinished(answers=answers):
                self._losses_in_a_row = 0
                self._settle(answers)
                for answer in answers:
                    self._advance(self._running.pop(answer.rank), answer)

    def _settle(self, answers: Sequence[Answer]) -> None:
        """Scenes are back, most of them with reports of all that they spent."""
        self._settle_unheard([answer.rank for answer in answers if not answer.report.counted])
        for answer in answers:
            if answer.rank in self._budget.granted:
                stages = answer.report.stages
                paid = sum((report.paid for report in stages), NOTHING)
                cost = sum((report.cost for report in stages if report.outcome is None), NOTHING)
                self._budget.settle(answer.rank, paid, cost)

    def _settle_unheard(self, ranks: Sequence[int]) -> None:
        """What a process spent that is gone stands only where it wrote it down."""
        asked = [rank for rank in ranks if rank in self._budget.granted]
        written_down = spent_by_grant(self._work.records_dir.parent) if asked else {}
        for rank in asked:
            self._budget.settle(rank, written_down.get(self._budget.granted[rank].name, NOTHING))

    def _advance(self, scene: InFlightScene, answer: Answer) -> None:
        if answer.report.input_lost:
            self._lose([scene], inputs_lost=True)
            return
        begun = scene.position
        for report in answer.report.stages:
            stage = scene.stage
            if isinstance(report.outcome, Failed) and report.outcome.error_kind == _OUT_OF_BUDGET:
                scene.tried[scene.position], scene.child_losses = report.attempts - 1, answer.report.losses
                self._hold(scene, moved=scene.position > begun)
                return
            if report.cost:
                scene.costs[stage.name] = report.cost
            scene.attempts = max(scene.attempts, report.attempts)
            scene.timings.append(StageTiming(stage.name, report.cpu_s, report.wall_s))
            self._tally.took(stage.name, report.cpu_s, report.wall_s)
            if report.outcome is not None:
                self._endings.not_done(scene, report)
                return
            if scene.position + 1 == len(scene.line):
                self._finish(scene, answer.payload)
                return
            self._tally.passed[stage.name] += 1
            scene.position += 1
        scene.payload, scene.kept = answer.payload, ""
        self._waiting[scene.rank] = scene

    def _finish(self, scene: InFlightScene, payload: Payload) -> None:
        try:
            exported = self._executor.fetch(payload)
        except PayloadLostError as error:
            self._count_loss(str(error))
            self._lose([scene], inputs_lost=True)
            return
        self._endings.done(scene, exported)

    def _hold(self, scene: InFlightScene, moved: bool) -> None:
        """A scene waits before the stage that may ask no more; where nothing is left at all, so does the build."""
        self.out_of_budget = self._budget.is_spent
        if moved:
            self._kept.resume([scene], inputs_lost=True)
        self._waiting[scene.rank] = scene

    def _count_loss(self, why: str) -> None:
        """Workers come and go; but where none of them answers any more, a person must see to it."""
        self._tally.losses += 1
        self._losses_in_a_row += 1
        if self._losses_in_a_row >= MAX_LOSSES_PER_CALL * self._crew.most_calls:
            raise BuildError(
                f"{self._losses_in_a_row} workers were lost in a row, the last one with: {why}. Finished scenes are "
                "kept: see to the cluster, then run the same command to go on"
            )

    def _lose(self, scenes: Sequence[InFlightScene], inputs_lost: bool) -> None:
        """A worker or a record is gone. The scenes are not to blame, unless it happens to one again and again."""
        again = []
        for scene in scenes:
            scene.losses += 1
            if scene.losses >= MAX_LOSSES_PER_SCENE:
                self._endings.lost(scene)
            else:
                again.append(scene)
        self._kept.resume(again, inputs_lost)
        self._waiting |= {scene.rank: scene for scene in again}

    def _show(self) -> None:
        self._tally.queued = Counter(scene.stage.name for scene in self._waiting.values())
        self._tally.running = Counter(scene.stage.name for scene in self._running.values())
        alive = self._crew.alive
        self._tally.actors = {pool: Actors(alive[pool], size) for pool, size in self._crew.sizes.items()}
        self._tally.committed, self._tally.bytes_committed = self._ledger.committed, self._ledger.bytes_committed
        self._tally.restarts = self._crew.restarts
        self._display.show(self._tally)
