"""Rows of trajectories/: one per accepted task, with what came of it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from tableverse_factory.stages.trajectories.failed_rows import MAX_DETAIL, failed_row
from tableverse_factory.stages.trajectories.search import Attempt, PlannedTask


def trajectory_row(
    task: Mapping[str, Any], config: TrajectoriesConfig, found: PlannedTask, arrays: str | None
) -> dict[str, Any]:
    """The row of a task that was searched.

    Args:
        task: Its row of tasks/.
        config: Names of robot, grasp model and planner.
        found: How it ended.
        arrays: The scene's file with the motion; None where none was executed.
    """
    row = failed_row(task, config, found.reason, found.detail)
    row |= {"grasp_candidates": found.candidates, "tried": found.tried, "arrays": arrays}
    return row if found.attempt is None else {**row, **_attempted(found.attempt, found)}


def _attempted(attempt: Attempt, found: PlannedTask) -> dict[str, Any]:
    row: dict[str, Any] = {
        "success": attempt.success,
        "failed_phase": attempt.failed_phase or None,
        "reason": attempt.reason or None,
        "detail": _detail(attempt.detail, found.detail) or None,
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
            "fallbacks": list(attempt.fallbacks),
            "survives": list(found.survives) if attempt.success else None,
        }
    return row


def _detail(furthest: str, tally: str) -> str:
    """Why the attempt failed that came furthest, and why how many failed; the tally is short and never cut."""
    tally = f" ({tally})" if tally else ""
    return f"{furthest[: MAX_DETAIL - len(tally)]}{tally}"


def _base(base: Pose) -> dict[str, float]:
    w, _, _, z = base.quaternion_wxyz
    return {
        "base_x_m": float(base.position[0]),
        "base_y_m": float(base.position[1]),
        "base_z_m": float(base.position[2]),
        "base_yaw_rad": float(2 * np.arctan2(z, w)),
    }
