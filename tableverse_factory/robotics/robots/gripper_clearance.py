"""How far a gripper comes and goes in straight lines, and how wide it is open then.

Grasps are given this room, bases this reach, and motions are planned with it: all read it here.
"""

import numpy as np

from schemas.trajectories import Numbers

STANDOFF_M = 0.08
"""Straight way of the empty gripper to a grasp and back from a release (GenManip's stand-offs, both)."""

RISE_M = 0.16
"""Straight way of the object up from where it stands, and down to where it is let go."""

FINGER_ROOM_M = 0.01
"""Between each finger and its contact while the gripper comes; where that is nearly all there is, it is wide open."""

_NEARLY_OPEN = 0.95


def openings(widths: Numbers, max_opening_m: float) -> Numbers:
    """How far the fingers are apart while the gripper comes to grasps of these widths. Shape (n,) [m]."""
    narrow = widths + 2 * FINGER_ROOM_M
    return np.where(narrow < _NEARLY_OPEN * max_opening_m, narrow, max_opening_m)
