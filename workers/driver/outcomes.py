"""Outcomes of scenes: done, dropped, failed, or postponed to a later run."""

from typing import Any

from schemas.manifest import ImageRow
from schemas.outcome import Dropped, Failed
from schemas.work import CommitCall, ScenePart, SceneResult, StageReport, Status
from tableverse_factory.core.errors import (
    BuildError,
    ConfigError,
    ModelAccessError,
    ModelError,
    StoreError,
    WeightsError,
)
from tableverse_factory.rebuild import MANIFEST_STAGE
from tableverse_factory.stage import Stage
from workers.driver.in_flight import InFlightScene
from workers.progress.tally import Display, Tally
from workers.state.ledger import Ledger

_ACCESS_KINDS = frozenset({ModelAccessError.__name__, WeightsError.__name__})
_FATAL_KINDS = frozenset({*_ACCESS_KINDS, StoreError.__name__})  # they would recur for every scene
_CONFIG_ERROR = ConfigError.__name__  # fatal where a stage adds to finished scenes: a misspelt key must not fail them
_MODEL_SILENT = ModelError.__name__  # postpones a scene there: with failed rows it would count as done for ever
_MAX_SILENT_IN_A_ROW = 5  # postponed scenes in a row that stop the build: the model server is down
_MAX_TRACES = 3  # failures of a stage that are shown with their traceback


class OutcomeRecorder:
    """Writer of outcomes into the ledger, with their counts and notes for the user."""

    def __init__(self, ledger: Ledger, tally: Tally, display: Display) -> None:
        self._ledger, self._tally, self._display = ledger, tally, display
        self._silent_in_a_row = 0
        self.commits: list[CommitCall] = []  # of the shards that became whole

    def record_done(self, scene: InFlightScene, part: ScenePart) -> None:
        """Record a scene whose part a worker has written."""
        self._silent_in_a_row = 0
        self._record(scene, "done", part=part)

    def record_unfinished(self, scene: InFlightScene, report: StageReport) -> bool:
        """Record a scene that a stage dropped or failed, or postpone it to a later run.

        False if the scene goes on: a stage that adds to finished scenes has failed, and rows will say so.
        """
        adds, outcome = scene.stage.is_post_export, report.outcome
        if isinstance(outcome, Failed):
            if outcome.error_kind in _FATAL_KINDS or (adds and outcome.error_kind == _CONFIG_ERROR):
                advice = _advise_correction(scene.stage, outcome.error_kind)
                why = outcome.message.rstrip(".")
                raise BuildError(f"{why}. Finished scenes are kept: run the same command to go on{advice}")
            if adds and outcome.error_kind == _MODEL_SILENT:
                self._postpone(scene, outcome.message)
                return True
            self._note_failure(scene, outcome, report.trace)
        return self._record_loss(scene, outcome)

    def record_lost(self, scene: InFlightScene) -> bool:
        """Record a scene whose worker was lost too often as failed; False if it goes on."""
        return self._record_loss(scene, Failed("lost", f"its worker was lost {scene.losses} times"))

    def record_rejected(self, rank: int, row: ImageRow) -> None:
        """Record a rejected row of the manifest as dropped."""
        self._tally.ended[MANIFEST_STAGE, "dropped"] += 1
        self._write(rank, SceneResult(row, "dropped", MANIFEST_STAGE, row.rejected, detail=row.rejected_detail))

    def _note_failure(self, scene: InFlightScene, failure: Failed, trace: str) -> None:
        shows_trace = trace and self._tally.ended[scene.stage.name, "failed"] < _MAX_TRACES
        text = f"{scene.row.scene_id}: {scene.stage.name} failed: {failure}"
        self._display.note(f"{text}\n{trace}" if shows_trace else text)

    def _postpone(self, scene: InFlightScene, why: str) -> None:
        """Leave a finished scene unchanged, without the rows of the stage that adds; a later run tries again."""
        self._tally.postponed += 1
        self._silent_in_a_row += 1
        self._display.note(f"{scene.row.scene_id}: {scene.stage.name} is left for a later run: {why}")
        if self._silent_in_a_row >= _MAX_SILENT_IN_A_ROW:
            raise BuildError(f"{why}; {_MAX_SILENT_IN_A_ROW} scenes in a row were left. Run the same command to go on")

    def _record_loss(self, scene: InFlightScene, outcome: Dropped | Failed | None) -> bool:
        if scene.stage.record_failure is not None and scene.failure is None:
            scene.failure, scene.losses = outcome, 0
            return False
        match outcome:
            case Dropped(reason=reason, detail=detail):
                self._record(scene, "dropped", reason=reason, detail=detail)
            case Failed(error_kind=kind, message=message):
                self._record(scene, "failed", error_kind=kind, detail=message)
        return True

    def _record(self, scene: InFlightScene, status: Status, **more: Any) -> None:
        self._tally.ended[scene.stage.name, status] += 1
        more |= {"attempts": scene.attempts, "timings": tuple(scene.timings), "costs": tuple(scene.costs.items())}
        self._write(scene.rank, SceneResult(scene.row, status, scene.stage.name, **more))

    def _write(self, rank: int, result: SceneResult) -> None:
        call = self._ledger.record(rank, result)
        if call is not None:
            self.commits.append(call)


def _advise_correction(stage: Stage, kind: str) -> str:
    """Advise how to resume with another configuration, which is refused without `--from`."""
    if stage.is_post_export or kind not in _ACCESS_KINDS:
        return ""
    return f"; where the configuration is wrong, correct it and add --from {stage.section}"
