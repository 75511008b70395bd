"""What happened to objects between the picture and the end: what toppled, and what slid."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from schemas.geometry import Pose
from schemas.objects import PlacedObject
from tableverse_factory.geometry.math.transforms import rotation_matrix, transform_points
from tableverse_factory.geometry.mesh.meshes import box_center

TOPPLED_RAD = float(np.deg2rad(30.0))  # a larger tilt than levelling and leaning against another thing make
SLID_M = 0.04


@dataclass(frozen=True, slots=True)
class Displacement:
    """Motion of an object from where the picture put it: of its box's centre [m], and of its vertical axis [rad]."""

    distance_m: float
    tilt_rad: float

    @property
    def kind(self) -> Literal["", "toppled", "slid"]:
        """Whether it toppled, or else slid; empty if it stands about as in the picture."""
        return "toppled" if self.tilt_rad > TOPPLED_RAD else "slid" if self.distance_m > SLID_M else ""


def measure_displacement(item: PlacedObject, pose: Pose) -> Displacement | None:
    """Measure the motion of an object to its present pose; None for a copy, which no picture placed."""
    if item.copy_of is not None:
        return None
    center = box_center(item.mesh)[None]
    moved = transform_points(pose, center, item.scale) - transform_points(item.pose, center, item.scale)
    before, now = (rotation_matrix(its.quaternion_wxyz) for its in (item.pose, pose))
    upward = np.clip(float(now[2] @ before[2]), -1.0, 1.0)  # of the turn between them: (now @ before.T)[2, 2]
    return Displacement(float(np.linalg.norm(moved)), float(np.arccos(upward)))
