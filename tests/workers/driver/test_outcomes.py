"""Outcomes of scenes, in memory: what is recorded, what stops a build, what is postponed."""

from dataclasses import replace

import pytest

from schemas.outcome import Failed
from schemas.work import ScenePart, StageReport
from tableverse_factory.core.errors import BuildError
from tableverse_factory.stage import Stage
from tests.helpers.builds import Silent
from tests.helpers.fake_executor import STAGES, FakeLedger, make_rows, make_spec
from workers.driver.checkpoints import CheckpointIndex
from workers.driver.in_flight import InFlightScene
from workers.driver.outcomes import OutcomeRecorder
from workers.progress.tally import Tally

ADDING = Stage(
    "trajectories", "trajectories", lambda *_: None, reads=("trajectories",), record_failure=lambda item, *_: item
)
PART = ScenePart("0123.parts", 0, 10, 20)


class Recorder:
    """A recorder with its ledger, tally and display."""

    def __init__(self, folder, stages=STAGES, n=3):
        self.spec = make_spec(folder, make_rows(n), stages)
        self.ledger, self.display = FakeLedger(n), Silent()
        self.tally = Tally(("manifest", *(stage.name for stage in stages)), n, 0, 1)
        self.checkpoints = CheckpointIndex(self.spec)
        self.outcomes = OutcomeRecorder(self.ledger, self.tally, self.display)

    def scene(self, rank: int, position: int) -> InFlightScene:
        return replace(self.checkpoints.start(rank), position=position)

    def fail(self, rank: int, position: int, kind: str, message: str = "m") -> InFlightScene:
        scene = self.scene(rank, position)
        ended = self.outcomes.record_unfinished(scene, StageReport(Failed(kind, message), 1, 0.1, 0.1))
        assert ended == (scene.failure is None)
        return scene


@pytest.mark.parametrize("kind", ["ModelAccessError", "StoreError"])
def test_errors_that_would_recur_for_every_scene_stop_the_build(tmp_path, kind):
    recorder = Recorder(tmp_path)
    with pytest.raises(BuildError, match="Finished scenes are kept"):
        recorder.fail(0, 1, kind, "no key")
    assert recorder.ledger.results == {}


def test_a_refused_model_advises_the_stage_to_restart_from(tmp_path):
    with pytest.raises(BuildError, match="correct it and add --from curate"):
        Recorder(tmp_path).fail(0, 2, "ModelAccessError")


def test_other_errors_fail_the_scene_alone(tmp_path):
    recorder = Recorder(tmp_path)
    recorder.fail(0, 1, "GeometryError", "3 vertices")
    result = recorder.ledger.results["s0"]
    assert (result.status, result.stage, result.error_kind, result.detail) == (
        "failed",
        "settle",
        "GeometryError",
        "3 vertices",
    )
    assert recorder.display.notes == ["s0: settle failed: GeometryError: 3 vertices"]


def test_a_silent_model_postpones_added_stages_and_stops_after_five_in_a_row(tmp_path):
    recorder = Recorder(tmp_path, (*STAGES, ADDING), n=9)
    for rank in range(4):
        recorder.fail(rank, 4, "ModelError", "no answer")
    recorder.outcomes.record_done(recorder.scene(4, 4), PART)
    for rank in range(5, 9):
        recorder.fail(rank, 4, "ModelError", "no answer")
    assert recorder.tally.postponed == 8
    assert list(recorder.ledger.results) == ["s4"]
    with pytest.raises(BuildError, match="5 scenes in a row"):
        recorder.fail(0, 4, "ModelError", "no answer")


def test_a_wrong_configuration_of_an_added_stage_stops_the_build(tmp_path):
    with pytest.raises(BuildError, match="Finished scenes are kept"):
        Recorder(tmp_path, (*STAGES, ADDING)).fail(0, 4, "ConfigError")
    recorder = Recorder(tmp_path)
    recorder.fail(0, 1, "ConfigError")
    assert recorder.ledger.results["s0"].status == "failed"


def test_a_failure_of_an_added_stage_is_first_written_as_rows(tmp_path):
    recorder = Recorder(tmp_path, (*STAGES, ADDING))
    scene = recorder.fail(0, 4, "crash", "SIGSEGV")
    assert scene.failure == Failed("crash", "SIGSEGV")
    assert recorder.ledger.results == {}
    assert recorder.outcomes.record_unfinished(scene, StageReport(Failed("crash", "again"), 1, 0.1, 0.1))
    assert recorder.ledger.results["s0"].status == "failed", "rows that cannot be written do not loop"
