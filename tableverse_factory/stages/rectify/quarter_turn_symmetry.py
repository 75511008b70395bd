"""Quarter-turn equivariance: a layout and its turns by 90°, 180° and 270° are computed alike."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.geometry.math.transforms import (
    conjugate_quaternion,
    multiply_quaternions,
    quaternion_about_z,
    rotation_matrix,
)
from tableverse_factory.stages.rectify.rigid_part import RigidPart

COINCIDENT_M = 1e-9
DECIMALS = 9


def count_quarter_turns(parts: Sequence[RigidPart]) -> int:
    """Count the quarter turns about z that bring the direction from the middle to the first part into quadrant one."""
    centers = np.array([part.mass_center_now[:2] for part in parts])
    way = centers[0] - centers.mean(axis=0)
    if np.linalg.norm(way) < COINCIDENT_M:
        way = parts[0].heading
    way = np.round(way, DECIMALS)  # on an axis, rounding errors would choose the quadrant
    return int(np.floor(-np.arctan2(way[1], way[0]) / (np.pi / 2))) % 4 + 1


def rotate_about_origin(part: RigidPart, quarters: int) -> RigidPart:
    """Rotate a part about the origin, its coordinates rounded to nanometres."""
    turn = quaternion_about_z(np.pi / 2 * quarters)
    center = part.mass_center_now
    turned = part.turned_by_quaternion(turn).moved(rotation_matrix(turn) @ center - center)
    return turned.rounded(DECIMALS)


def apply_motion(part: RigidPart, before: RigidPart, after: RigidPart, quarters: int) -> RigidPart:
    """Apply the motion of its rotated copy, from `before` to `after`, to a part."""
    back = quaternion_about_z(-np.pi / 2 * quarters)
    if after.turned_by is not before.turned_by:
        there = multiply_quaternions(after.turned_by, conjugate_quaternion(before.turned_by))
        turn = multiply_quaternions(multiply_quaternions(back, there), conjugate_quaternion(back))
        part = part.turned_by_quaternion(turn)
    return part.moved(rotation_matrix(back) @ (after.mass_center_now - before.mass_center_now))
