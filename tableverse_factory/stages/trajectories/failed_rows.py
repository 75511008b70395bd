"""Rows of trajectories/ for tasks without a result."""

from collections.abc import Mapping, Sequence
from typing import Any

from schemas.config import Config, TrajectoriesConfig
from schemas.outcome import Dropped, Failed
from schemas.scene import ExportedScene
from tableverse_factory.dataset.trajectory_files import add_trajectories

MAX_DETAIL = 500


def with_failed_trajectories(scene: ExportedScene, config: Config, failure: Dropped | Failed) -> ExportedScene:
    """Return the scene with a failed trajectory for each accepted task, because the stage did not end."""
    settings = config.trajectories
    why, detail = (
        (failure.reason, failure.detail) if isinstance(failure, Dropped) else (failure.error_kind, failure.message)
    )
    rows = [build_failed_row(task, settings, why, detail) for task in select_accepted_tasks(scene, settings)]
    return add_trajectories(scene, rows)


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
