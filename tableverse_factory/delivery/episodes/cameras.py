"""Cameras of episodes: the scene's own, one beside the robot, and one for films."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from schemas.geometry import Camera, Points, Pose, Vector3
from tableverse_factory.dataset.scene_meta import read_meta_camera
from tableverse_factory.delivery.episodes.actors import ArmMeshes
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import compose_poses, normalize_quaternion, transform_points
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.physics.render.views import frame_points
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.robots.arm import Arm

FIELD_OF_VIEW = float(np.deg2rad(44.0))  # vertical, of the robot camera
WRIST_FIELD_OF_VIEW = float(np.deg2rad(75.0))  # vertical
_WRIST_GAP_M, _WRIST_TARGET_M = 0.05, (0.02, 0.0, 0.04)  # before the hand; in the gripper frame, beyond the fingertips
_EYE_M = (1.2, 0.85, 1.0)  # in the robot's base frame: across the table and to its left, with table and arm in view
_TARGET_M = (0.37, 0.02, 0.26)
_ELEVATION = float(np.deg2rad(33.0))
# Of the film camera about the viewer's side, from which instructions say left and right; never from beyond
_AZIMUTHS = tuple(np.deg2rad([0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0, 78.0, -78.0]))
_CLEAR_M = 0.05  # sufficient distance of the arm from the line of sight to the object
_PATH_MARGIN_M = 0.15  # table shown around the object's path
_FRAMING_SAMPLES = 40  # arm configurations considered for framing


@dataclass(frozen=True, slots=True)
class CameraShift:
    """Small displacement of a camera in its own frame: shift [m], rotation vector [rad], factor of the focal length."""

    shift_m: tuple[float, ...]  # x, y, z
    turn_rad: tuple[float, ...]
    zoom: float

    @property
    def pose(self) -> Pose:
        """The displaced camera in the frame of the camera before."""
        return Pose(np.array(self.shift_m), normalize_quaternion(np.array([1.0, *(np.array(self.turn_rad) / 2)])))

    def displace(self, eye: PosedCamera) -> PosedCamera:
        """Displace a camera that stands in the table frame."""
        camera = replace(eye.camera, fx=self.zoom * eye.camera.fx, fy=self.zoom * eye.camera.fy)
        return PosedCamera(camera, compose_poses(eye.camera_to_table, self.pose))


def place_robot_camera(base: Pose, width: int, height: int) -> PosedCamera:
    """Place a camera across the table from the robot and to its left, the same in every scene."""
    pose = compose_poses(base, look_at(np.array(_EYE_M), np.array(_TARGET_M)))
    return PosedCamera(_make_camera(FIELD_OF_VIEW, width, height), pose)


def mount_wrist_camera(arm: Arm) -> Pose:
    """Place a camera on the hand, beside the fingers, in the gripper frame; it looks between the fingertips."""
    shape = arm.shape
    before = float((shape.hand_centers + shape.hand_half_sizes)[:, 0].max()) + _WRIST_GAP_M
    eye = np.array([before, 0.0, float(shape.hand_centers[:, 2].mean())])
    return look_at(eye, np.array(_WRIST_TARGET_M), np.array([1.0, 0.0, 0.0]))


def place_wrist_camera(arm: Arm, tcp: Pose, width: int, height: int) -> PosedCamera:
    """Place the camera of a hand whose gripper frame is at `tcp` in the table frame."""
    pose = compose_poses(tcp, mount_wrist_camera(arm))
    return PosedCamera(_make_camera(WRIST_FIELD_OF_VIEW, width, height), pose)


def _make_camera(field_of_view: float, width: int, height: int) -> Camera:
    """Make a camera of square pixels from its vertical field of view [rad]."""
    focal = height / (2 * np.tan(field_of_view / 2))
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def place_film_camera(recording: Recording, figure: ArmMeshes, width: int, height: int) -> PosedCamera:
    """Place a camera for people: as near as the whole motion of arm and object allows.

    It stands on the side from which instructions say left and right, so that a film never mirrors them, and there where
    the arm hides the object least, from the grasp to the release: a robot on that side itself is seen from beside it.
    """
    flat, up = np.cos(_ELEVATION), np.sin(_ELEVATION)
    sides = [np.array([flat * np.sin(angle), -flat * np.cos(angle), up]) for angle in _AZIMUTHS]
    samples = np.unique(np.rint(np.linspace(0, len(recording) - 1, _FRAMING_SAMPLES)).astype(int))
    arm = [_collect_arm_points(recording, figure, sample) for sample in samples]
    way = recording.object_pose[:, :3].astype(np.float64)
    room = [
        sum(min(_measure_clearance(side, way[at], parts), _CLEAR_M) for at, parts in zip(samples, arm, strict=True))
        for side in sides
    ]
    side = sides[int(np.argmax(room))]
    margins = (-_PATH_MARGIN_M, _PATH_MARGIN_M)
    around = [way + np.array([x, y, 0.0]) for x in margins for y in margins]
    return frame_points(np.concatenate([*arm, *around]), look_at(side, np.zeros(3)), width, height)


def _collect_arm_points(recording: Recording, figure: ArmMeshes, sample: int) -> Points:
    """Collect the arm's vertices at a sample of a recording, in the table frame [m]. Shape (n, 3)."""
    figure.check_recording(recording)
    poses = figure.poses(recording.qpos[sample].astype(np.float64), recording.base)
    parts = zip(poses, figure.meshes, strict=True)
    return np.concatenate([transform_points(pose, mesh.vertices) for pose, mesh in parts])


def _measure_clearance(side: Vector3, target: Vector3, arm: Points) -> float:
    """Measure the arm's distance to the line of sight from a target along the unit vector `side` [m]."""
    away = arm - target
    along = away @ side
    before = away[along > 0.0] - along[along > 0.0, None] * side
    return float(np.linalg.norm(before, axis=1).min(initial=np.inf))


def load_scene_camera(meta: dict[str, Any], width: int, height: int) -> PosedCamera | None:
    """Load the photograph's camera, cropped centrally to this size; None where a scene has none."""
    eye = read_meta_camera(meta)
    if eye is None:
        return None
    own = eye.camera
    share = max(width / own.width, height / own.height)
    left, top = (own.width * share - width) / 2, (own.height * share - height) / 2
    cx, cy = (own.cx + 0.5) * share - 0.5 - left, (own.cy + 0.5) * share - 0.5 - top
    return PosedCamera(Camera(own.fx * share, own.fy * share, cx, cy, width, height), eye.camera_to_table)
