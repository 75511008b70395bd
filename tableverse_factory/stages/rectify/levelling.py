"""Levelling: standing parts are put flat on the table."""

from contextlib import suppress

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.vertical import UP

DOWN = np.array([0.0, 0.0, -1.0])
MAX_TILT_RAD = np.radians(4.0)  # standing parts are levelled by at most this; more is no noise


def stand_on_table(part: RigidPart) -> RigidPart:
    """Put a part on the table on the hull face on which it would rest, if that takes a turn within `MAX_TILT_RAD`.

    Of the downward faces within that angle it is the one nearest to the centre of mass, which is then lowest.
    """
    flat = part
    with suppress(QhullError):  # of a flat part
        planes = ConvexHull(part.body.solids.points).equations
        within = planes[planes[:, :3] @ DOWN >= np.cos(MAX_TILT_RAD)]
        if len(within):
            normal = within[np.argmin(-(within[:, :3] @ part.mass_center + within[:, 3])), :3]
            axis = np.cross(normal, DOWN)
            sine = float(np.linalg.norm(axis))
            flat = part.turned(axis / sine * np.arctan2(sine, float(normal @ DOWN))) if sine > 0.0 else part
    return flat.moved(-flat.lowest_now_m * UP)
