"""Packed demonstrations are the recorded motions; files of other content are refused."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import SPLITS
from tableverse_factory.evaluation.training.policy.chain import load_chain
from tableverse_factory.evaluation.training.policy.demonstrations import (
    OPENING_M,
    POINT_M,
    POSITION_M,
    QUATERNION,
    RELATIONS,
    STEP_S,
    Demonstrations,
)
from tableverse_factory.evaluation.training.policy.pack import order_by_distance, pack_demonstrations
from tableverse_factory.geometry.math.transforms import compose_poses, pose_from_rotation
from tests.helpers.pick_recording import WIDTH_M

pytestmark = pytest.mark.heavy


def test_they_invert_to_the_recorded_motion(dataset: Dataset, packed: Path) -> None:
    own, done = Demonstrations.read(packed), next(iter(dataset.scene("s-0").trajectories()))
    recording = done.recording()
    assert (len(own), RELATIONS[own.relations[0]]) == (1, done.row["relation"])
    kept = np.arange(0, len(recording), round(STEP_S / recording.step_s))
    assert own.ends.tolist() == [len(kept)]
    base = Pose(own.bases[0, :3].astype(np.float64), own.bases[0, 3:].astype(np.float64))
    rotations, positions = load_chain("panda").forward(recording.command[kept, :7])
    for row, rotation, position in zip(own.tcp, rotations, positions, strict=True):
        pose = compose_poses(base, pose_from_rotation(position, rotation))
        assert np.abs(row[:3] * POSITION_M - pose.position).max() < POSITION_M
        assert abs(row[3:] * QUATERNION @ pose.quaternion_wxyz) == pytest.approx(1.0, abs=1e-4)
    assert np.abs(own.carried[:, :3] * POSITION_M - recording.object_pose[kept, :3]).max() < POSITION_M
    assert np.abs(own.opening[:, 0] * OPENING_M - recording.command[kept, -1]).max() < OPENING_M
    assert np.array_equal(own.phases, recording.phase[kept])
    block = own.points[own.objects[0, 0]] * POINT_M
    assert np.abs(block).max(axis=0) == pytest.approx([WIDTH_M / 2, WIDTH_M / 2, 0.03], abs=1e-3)
    assert np.allclose(own.poses[own.objects[0, 0], :3], recording.object_pose[0, :3], atol=1e-3)


def test_the_file_gives_back_what_was_written_and_the_same_bytes(packed: Path, tmp_path: Path) -> None:
    own = Demonstrations.read(packed)
    own.write(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == packed.read_bytes()
    for field in fields(own):
        assert not getattr(own, field.name).flags.writeable


def test_a_scene_of_two_datasets_is_refused(dataset: Dataset) -> None:
    with pytest.raises(InputError, match="scene s-0 is in two of the datasets"):
        pack_demonstrations([dataset, dataset], tuple(SPLITS))


def test_a_dataset_without_motions_in_a_split_is_refused(dataset: Dataset) -> None:
    with pytest.raises(InputError, match=r"no motion of panda in nowhere succeeds"):
        pack_demonstrations([dataset], ("nowhere",))


def test_files_of_other_content_are_refused(packed: Path, tmp_path: Path) -> None:
    own, path, data = Demonstrations.read(packed), tmp_path / "bad.npz", packed.read_bytes()
    for damaged in (b"", b"PK no zip", data[: len(data) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="is not a file of packed demonstrations"):
            Demonstrations.read(path)
    arrays = {field.name: getattr(own, field.name) for field in fields(own)}
    for change in (
        {"points": np.array([{"a": 1}], dtype=object)},  # a pickle
        {"objects": own.objects + 100},
        {"ends": own.ends + 1},
        {"relations": own.relations + len(RELATIONS)},
        {"poses": own.poses * np.nan},
        {"phases": own.phases.astype(np.int64)},
    ):
        np.savez_compressed(path, **{**arrays, **change}, allow_pickle=True)
        with pytest.raises(InputError, match="is not a file of packed demonstrations"):
            Demonstrations.read(path)


def test_the_others_follow_by_their_distance_from_x() -> None:
    centers = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0], [0.1, 0, 0]])
    assert order_by_distance(centers, 0, 1)[:5].tolist() == [0, 1, 3, 2, -1]
    many = np.arange(20.0)[:, None] * [1.0, 0, 0]
    assert order_by_distance(many, 5, 19)[:4].tolist() == [5, 19, 4, 6]
