"""The loop that takes every scene through its line: it admits, assigns, listens, and writes down what is finished."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from schemas.codec import encode
from schemas.manifest import ImageRow
from schemas.outcome import Dropped, Failed
from schemas.work import SceneResult, StageCall, StageReport, StageTiming, Status
from tableverse_factory.errors import BuildError, ModelAccessError
from tableverse_factory.stage import Lines, Stage
from workers.executor import Ended, Executor, Job, Payload, PayloadLostError
from workers.ledger import Ledger
from workers.schedule import Limits, Ready, admit, assign, limits_for
from workers.telemetry import Actors, Display, Tally

MANIFEST_STAGE = "manifest"
MAX_LOSSES_PER_SCENE = 5
MAX_LOSSES_PER_CALL = 10
"""Losses without any answer between them, times the calls in flight: one machine that goes takes many calls along."""
STOPPING = frozenset({ModelAccessError.__name__})
"""Failures that no scene is to blame for and that would come again for every other one."""

_WAIT_S = 0.2


@dataclass(slots=True)
class _Scene:
    """A scene inside the line.

    Attributes:
        position: Its next stage, or the one that runs.
        payload: The input of that stage.
        attempts: The most attempts that any stage needed.
        losses: How often its worker was lost.
    """

    rank: int
    row: ImageRow
    line: Sequence[Stage]
    payload: Payload
    position: int = 0
    attempts: int = 0
    losses: int = 0
    timings: list[StageTiming] = field(default_factory=list)

    @property
    def stage(self) -> Stage:
        return self.line[self.position]


class Driver:
    """Runs what the ledger has still to do on an executor."""

    def __init__(
        self,
        rows: Sequence[ImageRow],
        lines: Lines,
        ledger: Ledger,
        executor: Executor,
        tally: Tally,
        display: Display,
    ) -> None:
        self._rows, self._lines, self._ledger, self._executor = rows, lines, ledger, executor
        self._tally, self._display = tally, display
        self._limits: Limits = limits_for(executor.calls, executor.pools)
        self._todo = ledger.todo()[::-1]
        self._waiting: dict[int, _Scene] = {}
        self._running: dict[int, _Scene] = {}
        self._workers: dict[int, str] = {}
        self._idle: set[int] = set()
        self._losses_in_a_row = 0

    def run(self, check: Callable[[], None]) -> None:
        """Works until every scene is accounted for.

        Args:
            check: Called several times a second; ends the loop by raising.

        Raises:
            BuildError: if the disk refuses, workers die faster than they answer, or a model wants what only a person
                can give.
        """
        while self._todo or self._waiting or self._running:
            check()
            self._admit()
            self._assign()
            self._show()
            for ended in self._executor.wait(_WAIT_S):
                self._hear(ended)
        self._show()

    def _admit(self) -> None:
        for _ in range(admit(len(self._waiting) + len(self._running), self._limits)):
            while self._todo and self._rows[self._todo[-1]].rejected:
                self._reject(self._rows[self._todo.pop()])
            if not self._todo:
                return
            rank = self._todo.pop()
            row = self._rows[rank]
            self._waiting[rank] = _Scene(rank, row, self._lines[row.kind], encode(row))

    def _assign(self) -> None:
        ready = [
            Ready(rank, self._executor.pool_of(scene.stage.pool), len(scene.line) - scene.position)
            for rank, scene in self._waiting.items()
        ]
        idle: dict[str, list[int]] = {}
        for number in self._idle:
            idle.setdefault(self._workers[number], []).append(number)
        for choice in assign(ready, idle, Counter(self._workers.values()), len(self._running), self._limits):
            worker = choice.worker
            if worker is None:
                worker = self._executor.start(choice.pool)
                self._workers[worker] = choice.pool
            self._idle.discard(worker)
            scene = self._waiting.pop(choice.rank)
            self._running[choice.rank] = scene
            call = StageCall(scene.row.scene_id, scene.row.kind.value, scene.position)
            self._executor.submit(worker, Job(scene.rank, call, scene.payload))

    def _hear(self, ended: Ended) -> None:
        scene = self._running.pop(ended.rank)
        if ended.report is None:
            del self._workers[ended.worker]
            self._lose(scene, ended.loss, restart=ended.input_lost)
            return
        self._idle.add(ended.worker)
        self._losses_in_a_row = 0
        stage, report = scene.stage, ended.report
        scene.attempts = max(scene.attempts, report.attempts)
        scene.timings.append(StageTiming(stage.name, report.cpu_s, report.wall_s))
        self._tally.took(stage.name, report.cpu_s, report.wall_s)
        if report.outcome is not None:
            self._end(scene, report)
        elif scene.position + 1 < len(scene.line):
            self._tally.passed[stage.name] += 1
            scene.position, scene.payload = scene.position + 1, ended.payload
            self._waiting[scene.rank] = scene
        else:
            self._finish(scene, ended.payload)

    def _finish(self, scene: _Scene, payload: Payload) -> None:
        try:
            exported = self._executor.fetch(payload)
        except PayloadLostError as error:
            self._lose(scene, str(error), restart=True)
            return
        self._record(scene, "done", exported=exported)

    def _end(self, scene: _Scene, report: StageReport) -> None:
        match report.outcome:
            case Dropped(reason=reason, detail=detail):
                self._record(scene, "dropped", reason=reason, detail=detail)
            case Failed(error_kind=kind, message=message) if kind in STOPPING:
                raise BuildError(f"{message}. Finished scenes are kept: run the same command to go on")
            case Failed(error_kind=kind, message=message):
                self._record(scene, "failed", error_kind=kind, detail=message)
                trace = (
                    f"\n{report.trace}" if report.trace and self._tally.ended[scene.stage.name, "failed"] <= 3 else ""
                )
                self._display.note(f"{scene.row.scene_id}: {scene.stage.name} failed: {kind}: {message}{trace}")

    def _lose(self, scene: _Scene, loss: str, restart: bool) -> None:
        """A worker or a record is gone. The scene is not to blame, unless it happens to it again and again."""
        self._tally.losses += 1
        self._losses_in_a_row += 1
        scene.losses += 1
        if self._losses_in_a_row >= MAX_LOSSES_PER_CALL * self._executor.calls:
            raise BuildError(
                f"{self._losses_in_a_row} workers were lost in a row, the last one with: {loss}. Finished scenes are "
                "kept: see to the cluster, then run the same command to go on"
            )
        if scene.losses >= MAX_LOSSES_PER_SCENE:
            self._record(scene, "failed", error_kind="lost", detail=f"its worker was lost {scene.losses} times")
            return
        if restart:
            scene.position, scene.payload, scene.attempts = 0, encode(scene.row), 0
            scene.timings.clear()
        self._waiting[scene.rank] = scene

    def _reject(self, row: ImageRow) -> None:
        result = SceneResult(
            row.scene_id, "dropped", MANIFEST_STAGE, row.rejected, "", row.rejected_detail, 0, (), None
        )
        self._tally.ended[MANIFEST_STAGE, "dropped"] += 1
        self._ledger.record(result)

    def _record(
        self,
        scene: _Scene,
        status: Status,
        reason: str = "",
        error_kind: str = "",
        detail: str = "",
        exported: bytes | None = None,
    ) -> None:
        self._tally.ended[scene.stage.name, status] += 1
        self._ledger.record(
            SceneResult(
                scene.row.scene_id,
                status,
                scene.stage.name,
                reason,
                error_kind,
                detail,
                scene.attempts,
                tuple(scene.timings),
                exported,
            )
        )

    def _show(self) -> None:
        self._tally.queued = Counter(scene.stage.name for scene in self._waiting.values())
        self._tally.running = Counter(scene.stage.name for scene in self._running.values())
        alive = Counter(self._workers.values())
        self._tally.actors = {pool: Actors(alive[pool], most) for pool, most in self._limits.workers.items()}
        self._tally.committed = self._ledger.committed
        self._display.show(self._tally)
