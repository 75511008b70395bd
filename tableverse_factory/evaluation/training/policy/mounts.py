"""Cameras of an arm at home."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from schemas.geometry import Pose
from tableverse_factory.delivery.episodes.cameras import place_robot_camera, place_wrist_camera
from tableverse_factory.evaluation.training.policy.chain import load_chain
from tableverse_factory.evaluation.training.policy.packed_pictures import SIZE
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import pose_from_rotation
from tableverse_factory.robotics.robots.registry import load_arm


def mount_cameras(robot: str) -> tuple[PosedCamera, PosedCamera]:
    """Return the `CAMERAS` in the frame of the arm's base, with the arm at home."""
    arm, chain, still = load_arm(robot), load_chain(robot), Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    rotation, position = chain.forward(arm.home[None])
    tcp = pose_from_rotation(position[0], rotation[0])
    height, width = SIZE
    return place_robot_camera(still, width, height), place_wrist_camera(arm, tcp, width, height)


def list_intrinsics(eye: PosedCamera) -> Float32[np.ndarray, "4"]:
    """List fx, fy, cx and cy [px]."""
    return np.array([eye.camera.fx, eye.camera.fy, eye.camera.cx, eye.camera.cy], dtype=np.float32)


def list_mounts(eyes: Sequence[PosedCamera]) -> Float32[np.ndarray, "c 7"]:
    """List positions [m] and quaternions wxyz."""
    poses = [eye.camera_to_table for eye in eyes]
    return np.array([[*pose.position, *pose.quaternion_wxyz] for pose in poses], dtype=np.float32)
