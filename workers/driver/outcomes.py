"""Outcomes of scenes: done, dropped, failed, or postponed to a later run."""

from schemas.codec import decode, encode
from schemas.manifest import ImageRow
from schemas.outcome import Dropped, Failed
from schemas.work import SceneResult, StageReport, Status
from tableverse_factory.core.errors import BuildError, ConfigError, ModelAccessError, ModelError, StoreError
from tableverse_factory.rebuild import MANIFEST_STAGE
from tableverse_factory.stage import Stage
from tableverse_factory.stages.trajectories.failed_rows import with_failed_trajectories
from workers.driver.checkpoints import CheckpointIndex
from workers.driver.in_flight import BuildSpec, InFlightScene
from workers.progress.tally import Display, Tally
from workers.state.ledger import Ledger

_FATAL_KINDS = frozenset({ModelAccessError.__name__, StoreError.__name__})  # they would recur for every scene
_CONFIG_ERROR = ConfigError.__name__  # fatal where a stage adds to finished scenes: a misspelt key must not fail them
_MODEL_SILENT = ModelError.__name__  # postpones a scene there: with failed rows it would count as done for ever
_MAX_SILENT_IN_A_ROW = 5  # postponed scenes in a row that stop the build: the model server is down
_MAX_TRACES = 3  # failures of a stage that are shown with their traceback


class OutcomeRecorder:
    """Writer of outcomes into the ledger, with their counts and notes for the user."""

    def __init__(
        self, spec: BuildSpec, ledger: Ledger, checkpoints: CheckpointIndex, tally: Tally, display: Display
    ) -> None:
        self._spec, self._ledger, self._checkpoints = spec, ledger, checkpoints
        self._tally, self._display = tally, display
        self._silent_in_a_row = 0

    def record_done(self, scene: InFlightScene, exported: bytes) -> None:
        """Record a scene with the output of its last stage."""
        self._silent_in_a_row = 0
        self._record(scene, "done", exported=exported)

    def record_unfinished(self, scene: InFlightScene, report: StageReport) -> None:
        """Record a scene that a stage dropped or failed, or postpone it to a later run."""
        match report.outcome:
            case Dropped(reason=reason, detail=detail):
                self._record(scene, "dropped", reason=reason, detail=detail)
            case Failed(error_kind=kind, message=message) if kind in _FATAL_KINDS or (
                scene.stage.is_post_export and kind == _CONFIG_ERROR
            ):
                advice = _advise_correction(scene.stage, kind)
                raise BuildError(f"{message}. Finished scenes are kept: run the same command to go on{advice}")
            case Failed(error_kind=kind, message=message) if scene.stage.is_post_export and kind == _MODEL_SILENT:
                self._postpone(scene, message)
            case Failed(error_kind=kind, message=message):
                self._record(scene, "failed", error_kind=kind, detail=message)
                shows_trace = report.trace and self._tally.ended[scene.stage.name, "failed"] <= _MAX_TRACES
                trace = f"\n{report.trace}" if shows_trace else ""
                self._display.note(f"{scene.row.scene_id}: {scene.stage.name} failed: {kind}: {message}{trace}")

    def record_lost(self, scene: InFlightScene) -> None:
        """Record a scene whose worker was lost too often as failed."""
        self._record(scene, "failed", error_kind="lost", detail=f"its worker was lost {scene.losses} times")

    def record_rejected(self, row: ImageRow) -> None:
        """Record a rejected row of the manifest as dropped."""
        self._tally.ended[MANIFEST_STAGE, "dropped"] += 1
        self._write(
            SceneResult(row.scene_id, "dropped", MANIFEST_STAGE, row.rejected, "", row.rejected_detail, 0, (), None)
        )

    def _postpone(self, scene: InFlightScene, why: str) -> None:
        """Leave a finished scene unchanged, without the rows of the stage that adds; a later run tries again."""
        self._tally.postponed += 1
        self._silent_in_a_row += 1
        self._display.note(f"{scene.row.scene_id}: {scene.stage.name} is left for a later run: {why}")
        if self._silent_in_a_row >= _MAX_SILENT_IN_A_ROW:
            raise BuildError(f"{why}; {_MAX_SILENT_IN_A_ROW} scenes in a row were left. Run the same command to go on")

    def _record(
        self,
        scene: InFlightScene,
        status: Status,
        reason: str = "",
        error_kind: str = "",
        detail: str = "",
        exported: bytes | None = None,
    ) -> None:
        if (
            status != "done"
            and scene.stage.is_post_export
            and (encoded := self._encode_failed_rows(scene, reason or error_kind, detail))
        ):
            status, reason, error_kind, detail, exported = "done", "", "", "", encoded
        self._tally.ended[scene.stage.name, status] += 1
        ended = (scene.row.scene_id, status, scene.stage.name, reason, error_kind, detail, scene.attempts)
        self._write(SceneResult(*ended, tuple(scene.timings), exported, tuple(scene.costs.items())))

    def _encode_failed_rows(self, scene: InFlightScene, why: str, detail: str) -> bytes | None:
        """Encode the input of a stage that adds, with rows of failure; None if the input is lost."""
        stage_input = self._checkpoints.read_input(scene)
        if stage_input is None:
            return None
        return encode(with_failed_trajectories(decode(stage_input), self._spec.config.trajectories, why, detail))

    def _write(self, result: SceneResult) -> None:
        whole = self._ledger.record(result)
        if whole and not self._spec.keep:
            self._checkpoints.delete(result.scene_id)


def _advise_correction(stage: Stage, kind: str) -> str:
    """Advise how to resume with another configuration, which is refused without `--from`."""
    if stage.is_post_export or kind != ModelAccessError.__name__:
        return ""
    return f"; where the configuration is wrong, correct it and add --from {stage.section}"
