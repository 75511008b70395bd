"""Packing of a dataset's successful motions into one file of demonstrations."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.delivery.learning.dataset_environment import filter_successes
from tableverse_factory.delivery.learning.item_parts import PARTS
from tableverse_factory.evaluation.benchmark.policy import sample_points
from tableverse_factory.evaluation.benchmark.splits import list_split_tasks
from tableverse_factory.evaluation.training.policy.chain import load_chain
from tableverse_factory.evaluation.training.policy.demonstrations import (
    OPENING_M,
    POINT_M,
    POINTS,
    POSITION_M,
    QUATERNION,
    RELATIONS,
    ROWS,
    STEP_S,
    Demonstrations,
)
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    pose_from_rotation,
    transform_points,
)
from tableverse_factory.physics.mjcf.scene_objects import load_mesh
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.robots.registry import load_arm

Row = Mapping[str, Any]
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class SceneMotions:
    """Successful motions of one scene, as rows of trajectories/, and its split."""

    dataset: Dataset
    scene_id: str
    rows: tuple[Row, ...]
    split: str


def pack_demonstrations(
    datasets: Sequence[Dataset],
    splits: Sequence[str] = ("train", "validation"),
    robot: str = "panda",
    on_scene: Callable[[int, int], object] = lambda _done, _total: None,
) -> Demonstrations:
    """Pack the successful motions of an arm in these splits, by dataset, scene and task.

    Those of `validation` are held out.

    Raises:
        InputError: `no_trajectories` where there are none.
    """
    packer, motions = _Packer(robot), list_motions(datasets, splits, robot)
    for done, own in enumerate(motions, 1):
        packer.add_scene(own.dataset.scene(own.scene_id), own.rows, own.split == "validation")
        on_scene(done, len(motions))
    return packer.finish()


def list_motions(datasets: Sequence[Dataset], splits: Sequence[str], robot: str) -> list[SceneMotions]:
    """List the scenes of these splits with successful motions of an arm, of one dataset after another.

    Splits are each dataset's own. Tasks of nouns that the benchmark holds out are left out. A scene of two datasets is
    refused.
    """
    found: list[SceneMotions] = []
    owner: dict[str, int] = {}
    for number, dataset in enumerate(datasets):
        for own in _list_scenes(dataset, splits, robot):
            if owner.setdefault(own.scene_id, number) != number:
                raise InputError(
                    f"scene {own.scene_id} is in two of the datasets, and its motions would count twice: give one"
                )
            found.append(own)
    if not found:
        names = ", ".join(str(dataset.path) for dataset in datasets)
        raise InputError(f"{names}: no motion of {robot} in {', '.join(splits)} succeeds", "no_trajectories")
    return found


def _list_scenes(dataset: Dataset, splits: Sequence[str], robot: str) -> list[SceneMotions]:
    tasks = list_split_tasks(dataset, robot)
    rows = dataset.trajectories.to_table(filter=filter_successes(robot)).to_pylist()
    scenes: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda row: (row["scene_id"], row["task_id"])):
        scene_id = row["scene_id"]
        if (split := tasks.get((scene_id, row["task_id"]))) is not None and split in splits:
            scenes.setdefault((scene_id, split), []).append(row)
    return [SceneMotions(dataset, scene_id, tuple(own), split) for (scene_id, split), own in scenes.items()]


class _Packer:
    """Demonstrations as they are collected."""

    def __init__(self, robot: str) -> None:
        self._chain, self._arm = load_chain(robot), load_arm(robot)
        self._points: list[np.ndarray] = []
        self._poses: list[np.ndarray] = []
        self._rows: list[Arrays] = []
        self._samples: list[Arrays] = []
        self._scenes = 0

    def add_scene(self, scene: Scene, rows: Sequence[Row], held_out: bool) -> None:
        """Add a scene's objects, and its motions."""
        first, files = len(self._points), scene.files()
        names = [str(item["object_id"]) for item in scene.meta["objects"]]
        poses = PARTS["poses"](scene)
        for name in names:
            points = sample_points(load_mesh(files, name), POINTS, make_rng(0, scene.scene_id, name))
            self._points.append(_quantize(points, POINT_M))
        self._poses += list(poses.astype(np.float32))
        centers = np.array(
            [
                transform_points(Pose(pose[:3], pose[3:]), POINT_M * points.astype(np.float64)).mean(axis=0)
                for pose, points in zip(poses, self._points[first:], strict=True)
            ]
        )
        trajectories = {trajectory.row["task_id"]: trajectory for trajectory in scene.trajectories()}
        for row in rows:
            recording = trajectories[row["task_id"]].recording()
            x, y = names.index(row["x_id"]), names.index(row["y_id"])
            self._rows.append(
                {
                    "objects": first + order_by_distance(centers, x, y),
                    "scenes": np.array(self._scenes),
                    "relations": np.array(RELATIONS.index(row["relation"])),
                    "held_out": np.array(held_out),
                    "bases": np.concatenate([recording.base.position, recording.base.quaternion_wxyz]),
                }
            )
            self._samples.append(self._pack_samples(recording))
        self._scenes += 1

    def _pack_samples(self, recording: Recording) -> Arrays:
        """Keep every sample at a multiple of `STEP_S`, and the last."""
        every = STEP_S / recording.step_s
        if abs(every - round(every)) > 1e-6:
            raise InputError(f"motions are sampled every {recording.step_s} s, which does not divide {STEP_S} s")
        kept = np.arange(0, len(recording), round(every))
        command, joints = recording.command[kept], len(self._arm.joint_names)
        measured = self._arm.compute_openings(recording.qpos[kept, joints:])
        return {
            "tcp": _pack_poses(self._compute_tcp(recording.base, command[:, :joints])),
            "carried": _pack_poses(recording.object_pose[kept]),
            "opening": _quantize(np.stack([command[:, -1], measured], axis=1), OPENING_M),
            "phases": recording.phase[kept].astype(np.uint8),
        }

    def _compute_tcp(self, base: Pose, joints: np.ndarray) -> np.ndarray:
        """Compute the gripper's pose in the table frame at commanded joints. Shape (t, 7)."""
        rotations, positions = self._chain.forward(joints)
        poses = [
            compose_poses(base, pose_from_rotation(position, rotation))
            for rotation, position in zip(rotations, positions, strict=True)
        ]
        return np.array([np.concatenate([pose.position, pose.quaternion_wxyz]) for pose in poses])

    def finish(self) -> Demonstrations:
        """Concatenate what was collected."""
        rows = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
        samples = {name: np.concatenate([own[name] for own in self._samples]) for name in self._samples[0]}
        return Demonstrations(
            points=np.stack(self._points),
            poses=np.stack(self._poses),
            objects=rows["objects"].astype(np.int32),
            scenes=rows["scenes"].astype(np.int32),
            relations=rows["relations"].astype(np.uint8),
            held_out=rows["held_out"].astype(np.uint8),
            bases=rows["bases"].astype(np.float32),
            ends=np.cumsum([len(own["phases"]) for own in self._samples]).astype(np.int32),
            **samples,
        )


def order_by_distance(centers: np.ndarray, x: int, y: int) -> np.ndarray:
    """List X, Y, and the objects nearest to X; -1 after the last. Shape (`ROWS`,)."""
    others = [k for k in np.argsort(np.linalg.norm(centers - centers[x], axis=1), kind="stable") if k not in (x, y)]
    found = [x, y, *others][:ROWS]
    return np.array([*found, *[-1] * (ROWS - len(found))])


def _pack_poses(poses: np.ndarray) -> np.ndarray:
    position, turn = _quantize(poses[:, :3], POSITION_M), poses[:, 3:].astype(np.float64)
    return np.concatenate([position, _quantize(turn, QUATERNION)], axis=1)


def _quantize(values: np.ndarray, unit: float) -> np.ndarray:
    steps = np.round(np.asarray(values, dtype=np.float64) / unit)
    if np.abs(steps).max(initial=0.0) > 32767:
        raise InputError(f"{float(np.abs(values).max()):.3f} is beyond {32767 * unit:.3f}, the most that is packed")
    return steps.astype(np.int16)
