"""A layout and the same layout turned by 90°, 180° or 270° look alike from here: computed alike, they end alike."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z, rotation_matrix
from tableverse_factory.stages.rectify.rigid_part import RigidPart

COINCIDENT_M = 1e-9
DECIMALS = 9
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def quarters_of(parts: Sequence[RigidPart]) -> int:
    """Quarter turns about z that bring the way from the middle to the first part into the first quadrant."""
    centers = np.array([part.mass_center_now[:2] for part in parts])
    way = centers[0] - centers.mean(axis=0)
    if np.linalg.norm(way) < COINCIDENT_M:
        way = parts[0].heading
    way = np.round(way, DECIMALS)  # on an axis, rounding errors would choose the quadrant
    return int(np.floor(-np.arctan2(way[1], way[0]) / (np.pi / 2))) % 4 + 1


def turned_about_origin(part: RigidPart, quarters: int) -> RigidPart:
    """The part in the layout turned about the origin, its coordinates in whole nanometres."""
    turn = quaternion_about_z(np.pi / 2 * quarters)
    center = part.mass_center_now
    turned = part.turned_by_quaternion(turn).moved(rotation_matrix(turn) @ center - center)
    return turned.rounded(DECIMALS)


def taken_over(part: RigidPart, before: RigidPart, after: RigidPart, quarters: int) -> RigidPart:
    """The part moved as its likeness in the turned layout was, from `before` to `after`."""
    back = quaternion_about_z(-np.pi / 2 * quarters)
    if after.turned_by is not before.turned_by:
        there = multiply_quaternions(after.turned_by, before.turned_by * CONJUGATE)
        part = part.turned_by_quaternion(multiply_quaternions(multiply_quaternions(back, there), back * CONJUGATE))
    return part.moved(rotation_matrix(back) @ (after.mass_center_now - before.mass_center_now))
