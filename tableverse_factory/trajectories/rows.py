"""Rows of trajectories/: one per accepted task, with what came of it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from tableverse_factory.trajectories.apart import Perished
from tableverse_factory.trajectories.search import Attempt, Found

MAX_DETAIL = 500


def trajectory_row(
    task: Mapping[str, Any], config: TrajectoriesConfig, found: Found, arrays: str | None
) -> dict[str, Any]:
    """The row of a task that was searched.

    Args:
        task: Its row of tasks/.
        config: Names of robot, grasp model and planner.
        found: How it ended.
        arrays: The scene's file with the motion; None where none was executed.
    """
    row = {**_asked(task, config), "grasp_candidates": found.candidates, "tried": found.tried, "arrays": arrays}
    if found.attempt is None:
        return {**row, "reason": found.reason, "detail": found.detail[:MAX_DETAIL]}
    return {**row, **_attempted(found.attempt, found.survives)}


def perished_row(task: Mapping[str, Any], config: TrajectoriesConfig, perished: Perished) -> dict[str, Any]:
    """The row of a task whose process did not come back with an answer."""
    return {**_asked(task, config), "reason": perished.kind, "detail": perished.detail[:MAX_DETAIL]}


def _asked(task: Mapping[str, Any], config: TrajectoriesConfig) -> dict[str, Any]:
    names = ("scene_id", "task_id", "x_id", "y_id", "relation", "instruction")
    return {
        **{name: task[name] for name in names},
        "success": False,
        "robot": config.robot,
        "grasp_model": config.grasp_model,
        "planner": config.planner,
        "tried": 0,
    }


def _attempted(attempt: Attempt, survives: tuple[str, ...]) -> dict[str, Any]:
    row: dict[str, Any] = {
        "success": attempt.success,
        "failed_phase": attempt.failed_phase or None,
        "reason": attempt.reason or None,
        "detail": attempt.detail[:MAX_DETAIL] or None,
        "grasp_stage": attempt.stage,
        "grasp_score": attempt.score,
        **_base(attempt.base),
    }
    if attempt.motion is not None and attempt.proof is not None:
        verdict = attempt.proof.verdict
        row |= {
            "duration_s": attempt.motion.duration_s,
            "lifted_m": verdict.lifted_m,
            "disturbed_m": verdict.disturbed_m,
            "survives": list(survives) if attempt.success else None,
        }
    return row


def _base(base: Pose) -> dict[str, float]:
    w, _, _, z = base.quaternion_wxyz
    return {
        "base_x_m": float(base.position[0]),
        "base_y_m": float(base.position[1]),
        "base_z_m": float(base.position[2]),
        "base_yaw_rad": float(2 * np.arctan2(z, w)),
    }
