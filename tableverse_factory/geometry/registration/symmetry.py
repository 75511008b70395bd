"""Rotational symmetry: a box has two folds about the vertical, a bottle all."""

import numpy as np
from scipy.spatial import cKDTree

from schemas.geometry import Matrix3, Points

FOLDS = (8, 6, 5, 4, 3, 2)  # candidates, from the most to the fewest
ODD_TURNS = (0.35, 1.13, 1.87, 2.61)  # no simple fractions of a turn: only a round shape is alike after all [rad]
MAX_QUERIES = 400
ALIKE = 0.02  # root mean square distance of a surface from itself turned that counts as alike, over its horizontal size


def count_heading_folds(samples: Points, tree: cKDTree, axis: int = 2) -> int:
    """Count the rotational folds about one of the mesh's own axes: 1 for no symmetry, 0 for a round shape.

    The samples (n, 3) lie evenly on the surface, about a point of the axis.
    """
    asked = samples[:: max(1, len(samples) // MAX_QUERIES)]
    across = np.delete(samples, axis, axis=1)
    allowed = ALIKE * float(np.ptp(across, axis=0).max()) + float(tree.query(asked, k=2)[0][:, 1].mean())
    if all(_measure_misfit(asked, tree, axis, turn) <= allowed for turn in ODD_TURNS):
        return 0
    return next((n for n in FOLDS if _measure_misfit(asked, tree, axis, 2 * np.pi / n) <= allowed), 1)


def _measure_misfit(asked: Points, tree: cKDTree, axis: int, turn: float) -> float:
    return float(np.sqrt((tree.query(asked @ rotation_about_axis(axis, turn).T)[0] ** 2).mean()))


def find_symmetry_turn(rotation: Matrix3, folds: int, axis: int) -> Matrix3:
    """Find the symmetry of a mesh about its own axis after which `rotation` leaves it nearest to unrotated."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    sine, cosine = rotation[first, second] - rotation[second, first], rotation[first, first] + rotation[second, second]
    angle = float(np.arctan2(sine, cosine))
    return rotation_about_axis(axis, 2 * np.pi / folds * round(angle * folds / (2 * np.pi)) if folds else angle)


def rotation_about_axis(axis: int, angle: float) -> Matrix3:
    """Rotation about a coordinate axis [rad]."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[first, first] = turn[second, second] = np.cos(angle)
    turn[second, first], turn[first, second] = np.sin(angle), -np.sin(angle)
    return turn
