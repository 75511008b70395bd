"""Tasks whose trajectories were given up: a row each that says why, while the scene stays as it was exported."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from schemas.config import TrajectoriesConfig
from schemas.scene import ExportedScene

MAX_DETAIL = 500
_SHARED = ("scene_id", "task_id", "x_id", "y_id", "relation", "instruction")


def with_failed_trajectories(
    scene: ExportedScene, config: TrajectoriesConfig, reason: str, detail: str
) -> ExportedScene:
    """The scene with a failed trajectory for each task that was to be tried.

    Args:
        scene: As it was exported.
        config: Of the build.
        reason: Why the stage did not end: `timeout`, `crash`, `out_of_memory`, or the kind of an error.
        detail: One line for people.
    """
    return replace(
        scene, trajectory_rows=tuple(failed_row(task, config, reason, detail) for task in accepted_tasks(scene, config))
    )


def accepted_tasks(scene: ExportedScene, config: TrajectoriesConfig) -> Sequence[Mapping[str, Any]]:
    """Rows of the tasks that get a trajectory, or a reason why there is none."""
    return [row for row in scene.task_rows if row["accepted"]][: config.max_tasks]


def failed_row(task: Mapping[str, Any], config: TrajectoriesConfig, reason: str, detail: str) -> dict[str, Any]:
    """The row of trajectories/ of a task that nothing was tried for, or nothing is known of what was.

    Args:
        task: Its row of tasks/.
        config: Names of robot, grasp model and planner.
        reason: Code of what stood in the way.
        detail: One line for people.
    """
    return {
        **{name: task[name] for name in _SHARED},
        "success": False,
        "reason": reason,
        "detail": detail[:MAX_DETAIL],
        "robot": config.robot,
        "grasp_model": config.grasp_model,
        "planner": config.planner,
        "tried": 0,
    }
