"""What carries each object: the table, or the top of another object, read from the observed heights."""

import numpy as np

from schemas.geometry import Points
from schemas.objects import PerceivedObjects
from tableverse_factory.geometry.transforms import transform_points

CONTACT_M = 0.012
"""An object rests on another where its lowest points are at most this far below the other's top, or above it."""
GAP_M = 0.03
NEAR_M = 0.01


def support_heights(scene: PerceivedObjects) -> dict[str, float]:
    """Height of what carries each object, by object id [m], table frame; 0 is the table."""
    clouds = {o.object_id: transform_points(scene.camera_to_table, o.points_camera) for o in scene.objects}
    return {o.object_id: _support(o.object_id, o.contained_in, clouds) for o in scene.objects}


def _support(name: str, container: str | None, clouds: dict[str, Points]) -> float:
    own = clouds[name]
    if len(own) == 0:
        return 0.0
    lowest = float(np.quantile(own[:, 2], 0.02))
    if container is not None:
        return max(min(lowest, 0.006), 0.0)
    tops = [_top_below(own, lowest, clouds[other]) for other in clouds if other != name]
    return max([0.0, *tops])


def _top_below(own: Points, lowest: float, other: Points) -> float:
    """Height of `other` under the footprint of `own` if it lies just below it, else 0 [m]."""
    low, high = own[:, :2].min(axis=0) - NEAR_M, own[:, :2].max(axis=0) + NEAR_M
    under = other[((other[:, :2] >= low) & (other[:, :2] <= high)).all(axis=1)]
    if len(under) < 20:
        return 0.0
    top = float(np.quantile(under[:, 2], 0.9))
    return top if lowest - GAP_M <= top <= lowest + CONTACT_M and top > CONTACT_M else 0.0
