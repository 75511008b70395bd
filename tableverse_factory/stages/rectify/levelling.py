"""Things that stand stand flat: the small tilt that registration leaves is taken out."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Vector3
from tableverse_factory.stages.rectify.rigid_part import RigidPart

DOWN = np.array([0.0, 0.0, -1.0])


def levelled(part: RigidPart, most_rad: float) -> RigidPart:
    """The part turned onto the face of its hull on which it comes to rest, if a turn of at most `most_rad` does it.

    Of the faces within that angle from below it is the one nearest to the centre of mass: there the centre of mass is
    lowest.
    """
    planes = _planes(part)
    facing = planes[:, :3] @ DOWN
    within = np.flatnonzero(facing >= np.cos(most_rad))
    if not len(within):
        return part
    depths = -(planes[within, :3] @ part.mass_center + planes[within, 3])
    return part.turned(_onto_down(planes[within[int(np.argmin(depths))], :3]))


def _planes(part: RigidPart) -> Float64[np.ndarray, "n 4"]:
    try:
        planes: Float64[np.ndarray, "n 4"] = ConvexHull(part.body.solids.points).equations
    except QhullError:  # flat: nothing to stand on
        planes = np.zeros((0, 4))
    return planes


def _onto_down(normal: Vector3) -> Vector3:
    """The shortest turn that takes a unit vector near straight down there, as a rotation vector."""
    axis = np.cross(normal, DOWN)
    sine = float(np.linalg.norm(axis))
    turn: Vector3 = axis / sine * np.arctan2(sine, float(normal @ DOWN)) if sine > 0.0 else np.zeros(3)
    return turn
