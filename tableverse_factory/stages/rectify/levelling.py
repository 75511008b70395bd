"""Levelling: remove the small tilt that registration leaves in standing objects."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Vector3
from tableverse_factory.stages.rectify.rigid_part import RigidPart

DOWN = np.array([0.0, 0.0, -1.0])


def level_part(part: RigidPart, most_rad: float) -> RigidPart:
    """Turn a part onto the hull face on which it would rest, if that takes a turn of at most `most_rad`.

    Of the downward faces within that angle it is the one nearest to the centre of mass, which is then lowest.
    """
    planes = _compute_hull_planes(part)
    facing = planes[:, :3] @ DOWN
    within = np.flatnonzero(facing >= np.cos(most_rad))
    if not len(within):
        return part
    depths = -(planes[within, :3] @ part.mass_center + planes[within, 3])
    return part.turned(_rotation_to_down(planes[within[int(np.argmin(depths))], :3]))


def _compute_hull_planes(part: RigidPart) -> Float64[np.ndarray, "n 4"]:
    try:
        planes: Float64[np.ndarray, "n 4"] = ConvexHull(part.body.solids.points).equations
    except QhullError:  # flat
        planes = np.zeros((0, 4))
    return planes


def _rotation_to_down(normal: Vector3) -> Vector3:
    """Rotation vector of the shortest turn of a unit vector to straight down."""
    axis = np.cross(normal, DOWN)
    sine = float(np.linalg.norm(axis))
    return axis / sine * np.arctan2(sine, float(normal @ DOWN)) if sine > 0.0 else np.zeros(3)
