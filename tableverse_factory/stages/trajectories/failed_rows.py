"""Rows of trajectories/ for tasks without a result."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from schemas.config import TrajectoriesConfig
from schemas.scene import ExportedScene

MAX_DETAIL = 500


def with_failed_trajectories(
    scene: ExportedScene, config: TrajectoriesConfig, reason: str, detail: str
) -> ExportedScene:
    """Return the scene with a failed trajectory for each accepted task.

    `reason` is why the stage did not end: `timeout`, `crash`, `out_of_memory`, or the kind of an error.
    """
    rows = (build_failed_row(task, config, reason, detail) for task in select_accepted_tasks(scene, config))
    return replace(scene, trajectory_rows=tuple(rows))


def select_accepted_tasks(scene: ExportedScene, config: TrajectoriesConfig) -> Sequence[Mapping[str, Any]]:
    """Select rows of the tasks that get a trajectory, or a reason why there is none."""
    return [row for row in scene.task_rows if row["accepted"]][: config.max_tasks]


def build_failed_row(task: Mapping[str, Any], config: TrajectoriesConfig, reason: str, detail: str) -> dict[str, Any]:
    """Build the row of a task that was not tried, or whose result is unknown."""
    return {
        **{name: task[name] for name in ("scene_id", "task_id", "x_id", "y_id", "relation", "instruction")},
        "success": False,
        "reason": reason,
        "detail": detail[:MAX_DETAIL],
        "robot": config.robot,
        "grasp_model": config.grasp_model,
        "planner": config.planner,
        "tried": 0,
    }
