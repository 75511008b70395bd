"""Rows of trajectories/: one per accepted task, with its result."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
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
    tally = f" ({found.detail})" if found.detail else ""  # short and never cut
    w, _, _, z = attempt.base.quaternion_wxyz
    row: dict[str, Any] = {
        "success": attempt.success,
        "failed_phase": attempt.failed_phase or None,
        "reason": attempt.reason or None,
        "detail": f"{attempt.detail[: MAX_DETAIL - len(tally)]}{tally}" or None,
        "grasp_stage": attempt.stage,
        "grasp_score": attempt.score,
        "base_x_m": float(attempt.base.position[0]),
        "base_y_m": float(attempt.base.position[1]),
        "base_z_m": float(attempt.base.position[2]),
        "base_yaw_rad": float(2 * np.arctan2(z, w)),
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
