"""A scene whose trajectories were given up as a whole: it stays as it was exported, and its tasks say why."""

from dataclasses import replace

from schemas.config import TrajectoriesConfig
from schemas.scene import ExportedScene


def given_up(scene: ExportedScene, config: TrajectoriesConfig, reason: str, detail: str) -> ExportedScene:
    """The scene with a failed trajectory for each task that was to be tried.

    Args:
        scene: As it was exported.
        config: Of the build.
        reason: Why the stage did not end: `timeout`, `crash`, `out_of_memory`, or the kind of an error.
        detail: One line for people.
    """
    accepted = [row for row in scene.task_rows if row["accepted"]][: config.max_tasks]
    shared = ("scene_id", "task_id", "x_id", "y_id", "relation", "instruction")
    chosen = {
        "success": False,
        "reason": reason,
        "detail": detail,
        "robot": config.robot,
        "grasp_model": config.grasp_model,
        "planner": config.planner,
        "tried": 0,
    }
    return replace(scene, trajectory_rows=tuple({**{name: row[name] for name in shared}, **chosen} for row in accepted))
