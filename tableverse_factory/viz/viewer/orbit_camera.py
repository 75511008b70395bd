"""Initial camera of the browser: at the photograph's camera, or in front of the table."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Points, Vector3
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.physics.render.views import frame_points

_WIDTH, _HEIGHT = 640, 480
_FROM = np.array([0.35, -1.0, 0.75])
_NEAREST_M, _FARTHEST_M, _AHEAD_M = 0.05, 20.0, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class OrbitCamera(Frozen):
    """An orbit camera in the table frame, z up."""

    position: Vector3  # [m]
    target: Vector3  # centre of the orbit [m]
    tan_up: float  # half the visible height at a distance of one metre [m]
    tan_side: float  # half the visible width there [m]

    def field_of_view(self, aspect: float) -> float:
        """Compute the vertical angle for a canvas of an aspect (width over height) to show the whole picture [rad]."""
        return float(2 * np.arctan(max(self.tan_up, self.tan_side / max(aspect, 0.1))))


def make_orbit_camera(eye: PosedCamera) -> OrbitCamera:
    """Make an orbit camera from a posed camera; its target is where the optical axis meets the table."""
    camera, position = eye.camera, np.array(eye.camera_to_table.position)
    ahead = rotation_matrix(eye.camera_to_table.quaternion_wxyz)[:, 2]
    distance = -position[2] / ahead[2] if ahead[2] < -1e-3 and position[2] > 0.0 else _AHEAD_M
    target = position + float(np.clip(distance, _NEAREST_M, _FARTHEST_M)) * ahead
    return OrbitCamera(position, target, camera.height / (2 * camera.fy), camera.width / (2 * camera.fx))


def make_front_camera(points: Points) -> OrbitCamera:
    """Make a camera in front of and above the table, as near as it sees all points (table frame, shape (n, 3)) [m]."""
    return make_orbit_camera(frame_points(points, look_at(_FROM, np.zeros(3)), _WIDTH, _HEIGHT))
