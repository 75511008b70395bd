"""Straight approach and lift distances, and gripper openings on approach, shared by grasps, bases and motions."""

import numpy as np

from schemas.trajectories import Numbers

# Straight travel of the empty gripper to a grasp and back from a release (GenManip's stand-offs, both)
STANDOFF_M = 0.08
LIFT_M = 0.16  # straight travel of the object up from its place, and down to its release
# Gap between each finger and its contact on approach; near the maximum opening the gripper is fully open
FINGER_CLEARANCE_M = 0.01
_NEARLY_OPEN = 0.95


def compute_approach_openings(widths: Numbers, max_opening_m: float) -> Numbers:
    """Compute the finger distance on approach to grasps of these widths. Shape (n,) [m]."""
    narrow = widths + 2 * FINGER_CLEARANCE_M
    return np.where(narrow < _NEARLY_OPEN * max_opening_m, narrow, max_opening_m)
