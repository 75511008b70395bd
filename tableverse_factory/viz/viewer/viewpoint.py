"""Where the browser's camera starts: where the picture was taken from, or in front of the table."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Points, Vector3
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.physics.render.views import Eye, framing

_WIDTH, _HEIGHT = 640, 480
_FROM = np.array([0.35, -1.0, 0.75])
_NEAREST_M, _FARTHEST_M, _AHEAD_M = 0.05, 20.0, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint(Frozen):
    """An orbit camera with z up.

    Attributes:
        position: In the table frame [m].
        target: What it turns around, in the table frame [m].
        tan_up: Half the height that is seen at one metre [m].
        tan_side: Half the width [m].
    """

    position: Vector3
    target: Vector3
    tan_up: float
    tan_side: float

    def field_of_view(self, aspect: float) -> float:
        """Vertical angle [rad] with which a canvas shows all that the picture shows.

        Args:
            aspect: Width of the canvas over its height.
        """
        return float(2 * np.arctan(max(self.tan_up, self.tan_side / max(aspect, 0.1))))


def viewpoint_of(eye: Eye) -> Viewpoint:
    """The orbit camera of an eye: its target is where the middle of the picture meets the table."""
    camera, position = eye.camera, np.array(eye.camera_to_table.position)
    ahead = rotation_matrix(eye.camera_to_table.quaternion_wxyz)[:, 2]
    distance = -position[2] / ahead[2] if ahead[2] < -1e-3 and position[2] > 0.0 else _AHEAD_M
    target = position + float(np.clip(distance, _NEAREST_M, _FARTHEST_M)) * ahead
    return Viewpoint(position, target, camera.height / (2 * camera.fy), camera.width / (2 * camera.fx))


def front_viewpoint(points: Points) -> Viewpoint:
    """In front of the table and above it, as near as all points allow.

    Args:
        points: What is to be seen, in the table frame [m]. Shape (n, 3).
    """
    return viewpoint_of(framing(points, look_at(_FROM, np.zeros(3)), _WIDTH, _HEIGHT))
