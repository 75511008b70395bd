"""A trajectory as consumers see it: what is shown of it, and that nobody takes another motion for it."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.trajectory import Trajectory
from tableverse_factory.delivery.episodes.selection import load_recording, open_episode, select_rows
from tableverse_factory.robotics.execution.arrays import encode_recording
from tests.helpers.recorded_dataset import recording, trajectory_row, two_scenes


@pytest.fixture
def out(tmp_path):
    return two_scenes(tmp_path / "out")


def rewritten(out) -> bytes:
    """Other commands, with which the zip is a valid one: the shard's tar has the bytes of its whole motion."""
    taken = recording()
    return encode_recording(replace(taken, command=taken.command + 0.25))


def test_a_motion_that_was_rewritten_is_refused_by_the_api_and_by_exports(out):
    other, true = rewritten(out), encode_recording(recording())
    assert len(other) == len(true)
    shard = out / "mjcf" / "shard-00000.tar"
    data = shard.read_bytes()
    assert data.count(true) == 1
    shard.write_bytes(data.replace(true, other))
    dataset = open_dataset(out)
    scene = dataset.scene("a-1")
    assert scene.files()["trajectories/task_000.npz"] == other
    with pytest.raises(InputError, match=r"trajectories/task_000\.npz is not the file that was written") as refused:
        scene.trajectory("task_000").recording()
    assert refused.value.reason == "bad_arrays"
    assert len(scene.trajectory("task_001").recording()) == 31
    with pytest.raises(InputError, match=r"scene a-1, trajectories/task_000\.npz is not the file"):
        open_episode(dataset, select_rows(dataset, failed=False)[0])


def test_a_row_without_a_digest_proves_nothing():
    data = encode_recording(recording(5))
    row = trajectory_row("a-1", "task_000", True)
    with pytest.raises(InputError, match="is not the file that was written"):
        Trajectory(row, data).recording()
    whole = Trajectory({**row, "arrays_sha256": hashlib.sha256(data).hexdigest()}, data).recording()
    assert np.array_equal(whole.command, recording(5).command)


def test_what_is_printed_of_a_trajectory_is_its_row(out):
    scene = open_dataset(out).scene("a-1")
    shown = repr(scene.trajectory("task_000"))
    assert "task_000" in shown
    assert len(shown) < 2000
    assert load_recording(scene, scene.trajectory_rows()[0]).robot == "panda"
