"""Gymnasium environment of a whole dataset: every reset draws a scene and a task."""

from typing import Any

import gymnasium
import numpy as np
import pyarrow.compute as pc

from schemas.geometry import Picture
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.splits import SPLITS, get_split
from tableverse_factory.delivery.episodes.observation import count_object_rows
from tableverse_factory.delivery.learning.environment import TableEnv
from tableverse_factory.robotics.robots.registry import load_arm

Task = tuple[str, str]
"""Ids of a scene and of one of its tasks."""


class DatasetEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):  # type: ignore[misc]
    """A `TableEnv` whose scene and task change with every reset, drawn from those that a recorded motion solves.

    `tasks` lists them. `info` of a reset names the drawn ones as `scene_id` and `task_id`.
    """

    metadata = TableEnv.metadata

    def __init__(
        self,
        dataset: str | Dataset,
        split: str | None = None,
        robot: str = "panda",
        *,
        max_objects: int | None = None,
        **options: Any,
    ) -> None:
        """List the tasks and open the first.

        Args:
            dataset: As in `open_dataset`, or an open one.
            split: `train`, `validation` or `test` (`dataset.splits`); None for all scenes.
            robot: As in `robots.registry.load_arm`; the motions that solve the tasks are of this arm.
            max_objects: Rows of `objects`; by default those of the largest scene of all splits, so that spaces agree.
            options: Those of `TableEnv`.
        """
        self._dataset = open_dataset(dataset) if isinstance(dataset, str) else dataset
        self.tasks = list_solved_tasks(self._dataset, split, robot)
        rows = count_object_rows(self._dataset) if max_objects is None else max_objects
        self._options = {**options, "robot": robot, "max_objects": rows}
        self._task, self._env = self.tasks[0], self._open(self.tasks[0])
        self.render_mode = self._env.render_mode
        self.action_space, self.observation_space = self._env.action_space, self._env.observation_space

    @property
    def current(self) -> TableEnv:
        """The environment of the present scene and task."""
        return self._env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Draw a scene and a task; `options["task"]`, one of `tasks`, chooses them. Others are those of `TableEnv`."""
        super().reset(seed=seed)
        rest = dict(options or {})
        drawn = self.tasks[int(self.np_random.integers(len(self.tasks)))]
        task = self._check_task(rest.pop("task", drawn))
        if task != self._task:
            self._task, self._env = task, self._open(task)
        observation, info = self._env.reset(seed=int(self.np_random.integers(2**31)), options=rest)
        return observation, {**info, "scene_id": task[0], "task_id": task[1]}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Execute one action (`TableEnv.step`)."""
        return self._env.step(action)

    def render(self) -> Picture | None:
        """Render the robot camera's picture (`TableEnv.render`)."""
        return self._env.render()

    def _open(self, task: Task) -> TableEnv:
        return TableEnv(self._dataset.scene(task[0]), task[1], **self._options)

    def _check_task(self, task: object) -> Task:
        for known in self.tasks:
            if task in (known, list(known)):
                return known
        raise ConfigError(f"task {sanitize_line(repr(task), 80)}: give one of `tasks`, as {self.tasks[0]}")


def list_solved_tasks(dataset: Dataset, split: str | None, robot: str) -> tuple[Task, ...]:
    """List the tasks of a split that a recorded motion of `robot` (`registry.load_arm`) solves, by scene and task."""
    if split is not None and split not in SPLITS:
        raise ConfigError(f"split {sanitize_line(repr(split), 60)}: give one of {', '.join(SPLITS)}, or None for all")
    rows = dataset.scenes.to_table(columns=["scene_id", "split"]).to_pylist()
    chosen = {row["scene_id"] for row in rows if split is None or get_split(row) == split}
    solved = dataset.trajectories.to_table(columns=["scene_id", "task_id"], filter=filter_successes(robot)).to_pylist()
    tasks = sorted((row["scene_id"], row["task_id"]) for row in solved if row["scene_id"] in chosen)
    if not tasks:
        raise InputError(
            f"{dataset.path}: no motion of {robot} solves a task of the {len(chosen)} scenes of "
            f"{split or 'all splits'} ({len(solved)} tasks of {len(rows)} scenes in all): "
            f"{'give another split, or ' if split else ''}build trajectories",
            "no_trajectories",
        )
    return tuple(tasks)


def filter_successes(robot: str) -> pc.Expression:
    """Filter rows of trajectories/ for motions of `robot` (`registry.load_arm`) that succeeded."""
    return pc.field("success") & (pc.field("robot") == load_arm(robot).name)


def make_environment(
    dataset: str, scene: str | None = None, task: str | None = None, split: str | None = None, **options: Any
) -> gymnasium.Env[dict[str, np.ndarray], np.ndarray]:
    """Make an environment from names alone, for `gymnasium.make` and worker processes.

    `scene` and `task` give a `TableEnv`; without them it is the `DatasetEnv` of `split`. `options` are those of
    `TableEnv`, except `max_steps`: Gymnasium itself truncates.
    """
    if "max_steps" in options:
        raise ConfigError(f"max_steps {options['max_steps']!r}: gymnasium.make has max_episode_steps, -1 for no limit")
    if scene is None and task is None:
        return DatasetEnv(dataset, split, max_steps=None, **options)
    if scene is None or task is None or split is not None:
        raise ConfigError(f"scene {scene!r}, task {task!r}, split {split!r}: give scene and task, or a split alone")
    return TableEnv(open_dataset(dataset).scene(scene), task, max_steps=None, **options)


make_environment.metadata = TableEnv.metadata  # type: ignore[attr-defined]  # Gymnasium's wrappers for `human` need it
