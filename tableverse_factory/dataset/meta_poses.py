"""Poses in an untrusted meta.json."""

from typing import Any

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.math.transforms import normalize_quaternion

FARTHEST_M = 1e3


def read_meta_pose(value: Any, owner: str) -> Pose:
    """Read `{"position": [x, y, z], "quaternion_wxyz": [w, x, y, z]}`, at most `FARTHEST_M` away [m].

    Args:
        value: As parsed.
        owner: For errors: an object's id, or `the camera`.

    Raises:
        InputError: `bad_meta` if it is no pose.
    """
    try:
        position, quaternion = (np.array(value[key], dtype=np.float64) for key in ("position", "quaternion_wxyz"))
        if position.shape != (3,) or quaternion.shape != (4,) or not np.abs(position).max() < FARTHEST_M:
            raise ValueError("numbers that make no pose")
        return Pose(position, normalize_quaternion(quaternion))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        problem = sanitize_line(str(error), 120)
        raise InputError(
            f"meta.json: a pose of {sanitize_line(owner, 60)} makes no sense: {problem}", "bad_meta"
        ) from None
