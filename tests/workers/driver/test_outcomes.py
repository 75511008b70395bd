"""Outcomes of scenes, in memory: what is recorded, what stops a build, what is postponed."""

from dataclasses import replace

import pytest

from schemas.outcome import Failed
from schemas.work import StageReport
from tableverse_factory.core.errors import BuildError
from tableverse_factory.stage import Stage
from tests.helpers.builds import Silent
from tests.helpers.fake_executor import STAGES, FakeLedger, make_rows, make_spec
from workers.driver.checkpoints import CheckpointIndex
from workers.driver.in_flight import InFlightScene
from workers.driver.outcomes import OutcomeRecorder
from workers.progress.tally import Tally
from workers.state.checkpoint_store import CheckpointStore

ADDING = Stage(
    "trajectories", "trajectories", lambda *_: None, reads=("trajectories",), post_export_tables=("trajectories",)
)


class Recorder:
    """A recorder with its ledger, tally and display."""

    def __init__(self, folder, stages=STAGES, n=3, keep=True):
        self.spec = make_spec(folder, make_rows(n), stages, keep=keep)
        self.ledger, self.display = FakeLedger(n), Silent()
        self.tally = Tally(("manifest", *(stage.name for stage in stages)), n, 0, 1)
        self.checkpoints = CheckpointIndex(self.spec, self.ledger)
        self.outcomes = OutcomeRecorder(self.spec, self.ledger, self.checkpoints, self.tally, self.display)

    def scene(self, rank: int, position: int) -> InFlightScene:
        return replace(self.checkpoints.start(rank), position=position)

    def fail(self, rank: int, position: int, kind: str, message: str = "m") -> None:
        self.outcomes.record_unfinished(self.scene(rank, position), StageReport(Failed(kind, message), 1, 0.1, 0.1))


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
    recorder.outcomes.record_done(recorder.scene(4, 4), b"exported")
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


def test_checkpoints_of_a_whole_shard_are_deleted_unless_kept(tmp_path):
    for keep in (True, False):
        recorder = Recorder(tmp_path / str(keep), n=1, keep=keep)
        store = CheckpointStore(recorder.spec.records_dir)
        scene = recorder.scene(0, 3)
        store.write(scene.records[0], b"output")
        recorder.outcomes.record_done(scene, b"exported")
        assert bool(store.index(0)) == keep
