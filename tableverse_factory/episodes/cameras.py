"""Where episodes are filmed from: the scene's own camera, and one that stands with the robot."""

from typing import Any

import numpy as np

from schemas.geometry import Camera, Pose
from tableverse_factory.errors import InputError
from tableverse_factory.geometry.transforms import compose, normalized_quaternion, rotation_matrix, transform_points
from tableverse_factory.physics.render import look_at
from tableverse_factory.physics.views import Eye, framing
from tableverse_factory.proof.arrays import Recording

FIELD_OF_VIEW = float(np.deg2rad(44.0))
"""Vertical, of the camera that stands with the robot."""

_EYE_M = (1.2, 0.85, 1.0)
_TARGET_M = (0.37, 0.02, 0.26)
"""In the robot's base frame: across the table from it and to its left, with table and arm in view."""

_ARM_M = ((0.0, 0.0, -0.03), (0.0, 0.0, 0.4))
_HAND_M, _ROUND_M = 0.08, 0.13
"""What a film shows above the gripper, and of the table around its way."""


def robot_eye(base: Pose, width: int, height: int) -> Eye:
    """A camera that stands across the table from the robot and to its left, the same in every scene.

    Args:
        base: The robot's base in the table frame.
        width: Of the picture [px].
        height: Of the picture [px].
    """
    focal = height / (2 * np.tan(FIELD_OF_VIEW / 2))
    camera = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    return Eye(camera, compose(base, look_at(np.array(_EYE_M), np.array(_TARGET_M))))


def film_eye(recording: Recording, width: int, height: int) -> Eye:
    """A camera for people: from the side of the robot on which left and right are as instructions say them.

    It is as near as the whole way of gripper and object, and the arm's foot and shoulder, allow.
    """
    turn = rotation_matrix(recording.base.quaternion_wxyz)
    sides = [turn @ (np.array(_EYE_M) * [1.0, sign, 1.0] - _TARGET_M) for sign in (1.0, -1.0)]
    nearest = min(sides, key=lambda side: float(side[1]))  # the viewer stands at -y
    way = np.concatenate([recording.tcp[:, :3], recording.object_pose[:, :3]]).astype(np.float64)
    arm = transform_points(recording.base, np.array(_ARM_M))
    around = [way * [1.0, 1.0, 0.0] + [x, y, 0.0] for x in (-_ROUND_M, _ROUND_M) for y in (-_ROUND_M, _ROUND_M)]
    points = np.concatenate([way, way + np.array([0.0, 0.0, _HAND_M]), *around, arm])
    return framing(points, look_at(nearest, np.zeros(3)), width, height)


def scene_eye(meta: dict[str, Any], width: int, height: int) -> Eye | None:
    """The camera of the photograph with a picture of this size, its middle cut out; None where a scene has none.

    Raises:
        InputError: `bad_meta` if meta.json holds a camera that makes no sense.
    """
    camera, pose = meta.get("camera"), meta.get("camera_to_table")
    if camera is None or pose is None:
        return None
    try:
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        wide, high = int(camera["width"]), int(camera["height"])
        position, quaternion = (np.array(pose[key], dtype=np.float64) for key in ("position", "quaternion_wxyz"))
        share = max(width / wide, height / high)
        left, top = (wide * share - width) / 2, (high * share - height) / 2
        cx, cy = (cx + 0.5) * share - 0.5 - left, (cy + 0.5) * share - 0.5 - top
        shown = Camera(fx * share, fy * share, cx, cy, width, height)
        if position.shape != (3,) or not np.isfinite([*position, fx, fy, cx, cy]).all() or min(wide, high, fx, fy) <= 0:
            raise ValueError("numbers that make no camera")
        return Eye(shown, Pose(position, normalized_quaternion(quaternion)))
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"meta.json: its camera makes no sense: {str(error)[:200]}", "bad_meta") from error
