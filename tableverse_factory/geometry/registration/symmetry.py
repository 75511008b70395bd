"""Which turns about the vertical bring a shape onto itself: a box has two, a bottle all of them."""

import numpy as np
from scipy.spatial import cKDTree

from schemas.geometry import Matrix3, Points

FOLDS = (8, 6, 5, 4, 3, 2)
"""How many headings may look alike, from the most to the least."""
ODD_TURNS = (0.35, 1.13, 1.87, 2.61)
"""No fraction of a full turn by a small number: only a round shape is alike after all of them [rad]."""
ASKED = 400
ALIKE = 0.02
"""Root mean square distance of a surface from itself turned that still counts as alike, over its horizontal size."""


def heading_folds(samples: Points, tree: cKDTree, axis: int = 2) -> int:
    """How many turns about one of the mesh's own axes leave it alike: 1 none but its own place, 0 all of them.

    Args:
        samples: Evenly on the surface, about the point that the axis goes through. Shape (n, 3).
        tree: Of the same samples.
        axis: 0 for x, 1 for y, 2 for z.
    """
    asked = samples[:: max(1, len(samples) // ASKED)]
    across = np.delete(samples, axis, axis=1)
    allowed = ALIKE * float(np.ptp(across, axis=0).max()) + float(tree.query(asked, k=2)[0][:, 1].mean())
    if all(_misfit(asked, tree, axis, turn) <= allowed for turn in ODD_TURNS):
        return 0
    return next((n for n in FOLDS if _misfit(asked, tree, axis, 2 * np.pi / n) <= allowed), 1)


def _misfit(asked: Points, tree: cKDTree, axis: int, turn: float) -> float:
    """Root mean square distance from the turned points to the samples."""
    return float(np.sqrt((tree.query(asked @ turn_about(axis, turn).T)[0] ** 2).mean()))


def nearest_alike(rotation: Matrix3, folds: int, axis: int) -> Matrix3:
    """The turn of a mesh about its own axis that leaves it alike and brings its frame, rotated, nearest to its own.

    Args:
        rotation: Of the mesh, applied after the turn.
        folds: About that axis, as `heading_folds` counts them.
        axis: 0 for x, 1 for y, 2 for z.
    """
    first, second = (axis + 1) % 3, (axis + 2) % 3
    sine, cosine = rotation[first, second] - rotation[second, first], rotation[first, first] + rotation[second, second]
    angle = float(np.arctan2(sine, cosine))
    return turn_about(axis, 2 * np.pi / folds * round(angle * folds / (2 * np.pi)) if folds else angle)


def turn_about(axis: int, angle: float) -> Matrix3:
    """The rotation about a coordinate axis."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[first, first] = turn[second, second] = np.cos(angle)
    turn[second, first], turn[first, second] = np.sin(angle), -np.sin(angle)
    return turn
