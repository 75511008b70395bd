"""Baseline `replay`: the recorded motion of the most similar task of a dataset's training split."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow.compute as pc
from jaxtyping import Float64

from schemas.geometry import Points, Pose
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.delivery.learning.dataset_environment import filter_successes
from tableverse_factory.delivery.learning.environment import FPS
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart, PolicyError
from tableverse_factory.evaluation.benchmark.splits import list_split_tasks
from tableverse_factory.geometry.math.transforms import invert_pose, quaternion_about_z, transform_points

Task = tuple[str, str]  # ids of scene and task
Features = Float64[np.ndarray, " 9"]
"""Positions of X and Y in the frame of the arm's base, and the extents of X, the longest first [m]."""

_COLUMNS = ("scene_id", "task_id", "relation", "x_id", "y_id", "base_x_m", "base_y_m", "base_z_m", "base_yaw_rad")
_PLACE = ("x_m", "y_m", "z_m")
_SIZE = ("size_x_m", "size_y_m", "size_z_m")


class ReplayPolicy:
    """Policy that plays the recorded commands of the training task that is nearest by `Features`.

    Of tasks of the same relation; the motion is not adapted.
    """

    pictures: tuple[str, ...] = ()
    picture_size = (96, 128)

    def __init__(self, dataset: str | None = None) -> None:
        """Open a dataset, of which the training tasks (`splits.list_split_tasks`) of the episodes' arm are replayed."""
        if dataset is None:
            raise ConfigError("the policy replay needs a dataset to replay: give its OUT as --weights")
        self._dataset = open_dataset(dataset)
        if not self._dataset.trajectories.to_table(["scene_id"], filter=pc.field("success")).num_rows:
            raise InputError(f"{dataset}: no motion to replay: build trajectories", "no_trajectories")
        self._tasks: dict[tuple[str, str], list[tuple[Task, Features]]] = {}  # by arm and relation
        self._robots: set[str] = set()

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode."""
        if start.robot not in self._robots:
            self._robots.add(start.robot)
            for relation, task, features in _list_demonstrations(self._dataset, start.robot):
                self._tasks.setdefault((start.robot, relation), []).append((task, features))
        if not (found := self._tasks.get((start.robot, start.relation.value))):
            raise PolicyError("no_demonstration", f"no training task of the relation {start.relation.value!r}")
        self._start, self._candidates = start, found
        self._actions: list[np.ndarray] = []
        self._step = 0

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Choose the demonstration at the first step, and play its next command."""
        if not self._actions:
            self._actions = self._load(self._choose(observation["objects"][:2, :3].astype(np.float64)))
        action = self._actions[min(self._step, len(self._actions) - 1)]
        self._step += 1
        return action

    def _choose(self, places: Points) -> Task:
        size = np.ptp(self._start.points[0].astype(np.float64), axis=0)
        own = _make_features(self._start.base, places, size)
        away = [float(np.abs(own - features).sum()) for _, features in self._candidates]
        return self._candidates[int(np.argmin(away))][0]

    def _load(self, task: Task) -> list[np.ndarray]:
        """Load the commands of a recording as actions of 1/50 s."""
        recording = self._dataset.scene(task[0]).trajectory(task[1]).recording()
        times = np.arange(0.0, len(recording) * recording.step_s, 1.0 / FPS)
        known = np.arange(len(recording)) * recording.step_s
        commands = np.stack([np.interp(times, known, column) for column in recording.command.T], axis=1)
        return [self._start.to_action(command) for command in commands]


def _list_demonstrations(dataset: Dataset, robot: str) -> list[tuple[str, Task, Features]]:
    """List relation, ids and features of the training tasks."""
    tasks = {task for task, split in list_split_tasks(dataset, robot).items() if split == "train"}
    if not tasks:
        raise InputError(f"{dataset.path}: no task of its training split to replay", "no_trajectories")
    columns = ["scene_id", "object_id", *_PLACE, *_SIZE]
    objects = {(row["scene_id"], row["object_id"]): row for row in dataset.objects.to_table(columns).to_pylist()}
    rows = dataset.trajectories.to_table(columns=list(_COLUMNS), filter=filter_successes(robot)).to_pylist()
    found = []
    for row in sorted(rows, key=lambda row: (row["scene_id"], row["task_id"])):
        if (task := (row["scene_id"], row["task_id"])) in tasks:
            x, y = (objects[row["scene_id"], row[key]] for key in ("x_id", "y_id"))
            found.append((row["relation"], task, _read_features(row, x, y)))
    return found


def _read_features(row: Mapping[str, Any], x: Mapping[str, Any], y: Mapping[str, Any]) -> Features:
    base = Pose(np.array([row[f"base_{axis}_m"] for axis in "xyz"]), quaternion_about_z(float(row["base_yaw_rad"])))
    places = np.array([[thing[name] for name in _PLACE] for thing in (x, y)], dtype=np.float64)
    return _make_features(base, places, np.array([x[name] for name in _SIZE]))


def _make_features(base: Pose, places: Points, size: Float64[np.ndarray, " 3"]) -> Features:
    return np.concatenate([transform_points(invert_pose(base), places).ravel(), np.sort(size)[::-1]])
