"""Where episodes are filmed from: the scene's own camera, and one that stands with the robot."""

from typing import Any

import numpy as np

from schemas.geometry import Camera, Points, Pose, Vector3
from tableverse_factory.core.errors import InputError
from tableverse_factory.delivery.episodes.actors import ArmFigure
from tableverse_factory.geometry.math.transforms import compose, normalized_quaternion, transform_points
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.physics.render.views import Eye, framing
from tableverse_factory.robotics.execution.arrays import Recording

FIELD_OF_VIEW = float(np.deg2rad(44.0))
"""Vertical, of the camera that stands with the robot."""

_EYE_M = (1.2, 0.85, 1.0)
_TARGET_M = (0.37, 0.02, 0.26)
"""In the robot's base frame: across the table from it and to its left, with table and arm in view."""

_ELEVATION = float(np.deg2rad(30.0))
_AZIMUTHS = tuple(np.deg2rad([0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 78.0, -78.0]))
"""Of a film's eye about the middle of the side from which instructions say left and right: never from beyond."""

_CLEAR_M = 0.05
"""The arm may come as near to the line from the eye to the object in the end."""

_ROUND_M = 0.15
"""What a film shows of the table around the object's way: with less, its near edge was cut off."""

_LOOKS = 40
"""Configurations of the arm that are looked at to frame it."""


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


def film_eye(recording: Recording, figure: ArmFigure, width: int, height: int) -> Eye:
    """A camera for people: as near as the whole arm, in all that it does, and the object's way allow.

    It stands where instructions say left and right from, so that a film never mirrors them: straight there if the arm
    does not stand before the object in the end, else as little to one side as it must; where the arm does from
    everywhere, as far from it as can be.

    Raises:
        InputError: `bad_arrays` if the recording is of another arm.
    """
    flat, up = np.cos(_ELEVATION), np.sin(_ELEVATION)
    sides = [np.array([flat * np.sin(angle), -flat * np.cos(angle), up]) for angle in _AZIMUTHS]
    arm = [_arm_points(recording, figure, sample) for sample in _looked_at(recording)]
    room = [min(_clearance(side, recording.object_pose[-1, :3], arm[-1]), _CLEAR_M) for side in sides]
    side = sides[int(np.argmax(room))]
    way = recording.object_pose[:, :3].astype(np.float64)
    around = [way + np.array([x, y, 0.0]) for x in (-_ROUND_M, _ROUND_M) for y in (-_ROUND_M, _ROUND_M)]
    return framing(np.concatenate([*arm, *around]), look_at(side, np.zeros(3)), width, height)


def _looked_at(recording: Recording) -> list[int]:
    """Samples all over a recording, the last one last."""
    return sorted(set(np.rint(np.linspace(0, len(recording) - 1, _LOOKS)).astype(int).tolist()))


def _arm_points(recording: Recording, figure: ArmFigure, sample: int) -> Points:
    """The arm's surface at a sample of a recording, in the table frame [m]. Shape (n, 3)."""
    if recording.qpos.shape[1] != figure.n_positions:
        detail = f"{recording.qpos.shape[1]} positions are recorded, and {recording.robot} has {figure.n_positions}"
        raise InputError(detail, "bad_arrays")
    poses = figure.poses(recording.qpos[sample].astype(np.float64), recording.base)
    parts = zip(poses, figure.meshes, strict=True)
    return np.concatenate([transform_points(pose, mesh.vertices) for pose, mesh in parts])


def _clearance(side: Vector3, target: Vector3, arm: Points) -> float:
    """How near the arm comes to the line from a target towards the eye [m].

    Args:
        side: Unit vector towards the eye.
        target: What is looked at [m].
        arm: Points of the arm [m]. Shape (n, 3).
    """
    away = arm - target.astype(np.float64)
    along = away @ side
    before = away[along > 0.0] - along[along > 0.0, None] * side
    return float(np.linalg.norm(before, axis=1).min(initial=np.inf))


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
