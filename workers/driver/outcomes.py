"""How scenes end: done, dropped, failed, left for a later run, or with the build; what ended is written down."""

from schemas.codec import decode, encode
from schemas.manifest import ImageRow
from schemas.outcome import Dropped, Failed
from schemas.work import SceneResult, StageReport, Status
from tableverse_factory.core.errors import BuildError, ConfigError, ModelAccessError, ModelError, StoreError
from tableverse_factory.stage import Stage
from tableverse_factory.stages.trajectories.failed_rows import with_failed_trajectories
from workers.driver.checkpoints import CheckpointIndex
from workers.driver.in_flight import InFlightScene
from workers.driver.job_spec import BuildSpec
from workers.progress.tally import Display, Tally
from workers.state.ledger import Ledger

MANIFEST_STAGE = "manifest"
_STOPPING = frozenset({ModelAccessError.__name__, StoreError.__name__})
"""Failures that no scene is to blame for and that would come again for every other one."""

_WRONG = ConfigError.__name__
"""Of a stage that adds, as such: scenes stay done, and none should get rows that fail for a word misspelt."""

_SILENT = ModelError.__name__
"""Of a stage that adds: a scene whose rows said so would count as done for ever, so it is left for a later run."""
_MAX_SILENT = 5
"""Scenes in a row that are left so before the build stops: whoever does not answer is not back soon."""


class OutcomeRecorder:
    """Writes every ending into the ledger, counts it, and says what a person should know."""

    def __init__(self, work: BuildSpec, ledger: Ledger, kept: CheckpointIndex, tally: Tally, display: Display) -> None:
        self._work, self._ledger, self._kept = work, ledger, kept
        self._tally, self._display = tally, display
        self._silent_in_a_row = 0

    def done(self, scene: InFlightScene, exported: bytes) -> None:
        """Its last stage gave this."""
        self._silent_in_a_row = 0
        self._record(scene, "done", exported=exported)

    def not_done(self, scene: InFlightScene, report: StageReport) -> None:
        """A stage was not done: the scene is dropped, failed, or left for a later run.

        Raises:
            BuildError: if a person must act, or too many scenes in a row are left.
        """
        match report.outcome:
            case Dropped(reason=reason, detail=detail):
                self._record(scene, "dropped", reason=reason, detail=detail)
            case Failed(error_kind=kind, message=message) if kind in _STOPPING or (scene.stage.adds and kind == _WRONG):
                raise BuildError(
                    f"{message}. Finished scenes are kept: run the same command to go on{_corrected(scene.stage, kind)}"
                )
            case Failed(error_kind=kind, message=message) if scene.stage.adds and kind == _SILENT:
                self._postpone(scene, message)
            case Failed(error_kind=kind, message=message):
                self._record(scene, "failed", error_kind=kind, detail=message)
                trace = (
                    f"\n{report.trace}" if report.trace and self._tally.ended[scene.stage.name, "failed"] <= 3 else ""
                )
                self._display.note(f"{scene.row.scene_id}: {scene.stage.name} failed: {kind}: {message}{trace}")

    def lost(self, scene: InFlightScene) -> None:
        """Its worker was lost too often."""
        self._record(scene, "failed", error_kind="lost", detail=f"its worker was lost {scene.losses} times")

    def rejected(self, row: ImageRow) -> None:
        """A row of the manifest cannot enter."""
        result = SceneResult(
            row.scene_id, "dropped", MANIFEST_STAGE, row.rejected, "", row.rejected_detail, 0, (), None
        )
        self._tally.ended[MANIFEST_STAGE, "dropped"] += 1
        self._write_down(result)

    def _postpone(self, scene: InFlightScene, why: str) -> None:
        """A scene stays as it was before a stage that would only add to it; a later run takes it up again."""
        self._tally.postponed += 1
        self._silent_in_a_row += 1
        self._display.note(f"{scene.row.scene_id}: {scene.stage.name} is left for a later run: {why}")
        if self._silent_in_a_row >= _MAX_SILENT:
            raise BuildError(f"{why}; {_MAX_SILENT} scenes in a row were left. Run the same command to go on")

    def _record(
        self,
        scene: InFlightScene,
        status: Status,
        reason: str = "",
        error_kind: str = "",
        detail: str = "",
        exported: bytes | None = None,
    ) -> None:
        if status != "done" and scene.stage.adds and (kept := self._given_up(scene, reason or error_kind, detail)):
            status, reason, error_kind, detail, exported = "done", "", "", "", kept
        self._tally.ended[scene.stage.name, status] += 1
        self._write_down(
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
                tuple(scene.costs.items()),
            )
        )

    def _given_up(self, scene: InFlightScene, why: str, detail: str) -> bytes | None:
        """The scene as it came into a stage that adds to it; None where that is lost."""
        before = self._kept.before(scene)
        if before is None:
            return None
        return encode(with_failed_trajectories(decode(before), self._work.config.trajectories, why, detail))

    def _write_down(self, result: SceneResult) -> None:
        whole = self._ledger.record(result)
        if whole and not self._work.keep:
            self._kept.forget(result.scene_id)


def _corrected(stage: Stage, kind: str) -> str:
    """How to go on where the configuration itself was wrong: another one is refused without being asked for."""
    if stage.adds or kind != ModelAccessError.__name__:
        return ""
    return f"; where the configuration is wrong, correct it and add --from {stage.section}"
