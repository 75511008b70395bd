"""Rows of trajectories/: one per accepted task, with its result."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from tableverse_factory.stages.trajectories.failed_rows import MAX_DETAIL, build_failed_row
from tableverse_factory.stages.trajectories.search import Attempt, PlannedTask


def build_trajectory_row(
    task: Mapping[str, Any], config: TrajectoriesConfig, found: PlannedTask, arrays: str | None
) -> dict[str, Any]:
    """Build the row of a searched task; `arrays` names its file, None where no motion was executed."""
    row = build_failed_row(task, config, found.reason, found.detail)
    row |= {"grasp_candidates": found.candidates, "tried": found.tried, "arrays": arrays}
    return row if found.attempt is None else {**row, **_describe_attempt(found.attempt, found)}


def _describe_attempt(attempt: Attempt, found: PlannedTask) -> dict[str, Any]:
    row: dict[str, Any] = {
        "success": attempt.success,
        "failed_phase": attempt.failed_phase or None,
        "reason": attempt.reason or None,
        "detail": _format_detail(attempt.detail, found.detail) or None,
        "grasp_stage": attempt.stage,
        "grasp_score": attempt.score,
        **_describe_base(attempt.base),
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


def _format_detail(furthest: str, tally: str) -> str:
    """Join the failure of the attempt that came furthest and the tally, which is short and never cut."""
    tally = f" ({tally})" if tally else ""
    return f"{furthest[: MAX_DETAIL - len(tally)]}{tally}"


def _describe_base(base: Pose) -> dict[str, float]:
    w, _, _, z = base.quaternion_wxyz
    return {
        "base_x_m": float(base.position[0]),
        "base_y_m": float(base.position[1]),
        "base_z_m": float(base.position[2]),
        "base_yaw_rad": float(2 * np.arctan2(z, w)),
    }
