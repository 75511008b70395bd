"""Poses as rows of numbers: position [m], then quaternion wxyz."""

import numpy as np
from jaxtyping import Float

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import normalize_quaternion


def compute_angles(a_wxyz: Float[np.ndarray, "*n 4"], b_wxyz: Float[np.ndarray, "*m 4"]) -> Float[np.ndarray, "*k"]:
    """Compute smallest angles between unit quaternions, which broadcast [rad]; exactly 0 between equal ones."""
    a, b = a_wxyz.astype(np.float64), b_wxyz.astype(np.float64)
    less, more = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    return 4.0 * np.arctan2(np.minimum(less, more), np.maximum(less, more))


def pose_from_row(row: Float[np.ndarray, "7"]) -> Pose:
    """Convert a row to a pose, with its quaternion normalized."""
    values = row.astype(np.float64)
    return Pose(values[:3], normalize_quaternion(values[3:]))
