"""What carries each object: the table, or the top of another object, read from the observed heights."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points
from schemas.objects import PerceivedObjects
from tableverse_factory.geometry.transforms import transform_points

ABOVE_M = 0.03
"""The lowest seen points of an object may lie this far above what carries it: its foot can be hidden."""
BELOW_M = 0.012
"""And this far below, for noise and for smeared pixels at the seam."""
TABLE_M = 0.012
"""Tops lower than this are the table's own noise."""
NEAR_M = 0.01
MIN_POINTS = 20
MIN_OVERLAP = 0.1
CONTAINER_FLOOR_M = 0.005
"""Height of the unseen floor of a container above the table."""


def support_heights(scene: PerceivedObjects) -> dict[str, float]:
    """Height of what carries each object, by object id [m], table frame; 0 is the table."""
    clouds = {o.object_id: transform_points(scene.camera_to_table, o.points_camera) for o in scene.objects}
    return {o.object_id: _support(o.object_id, o.contained_in, clouds) for o in scene.objects}


def _support(name: str, container: str | None, clouds: dict[str, Points]) -> float:
    own = clouds[name]
    if len(own) < MIN_POINTS:
        return 0.0
    lowest = float(np.quantile(own[:, 2], 0.02))
    if container is not None:
        return max(min(lowest, CONTAINER_FLOOR_M), 0.0)
    return max([0.0, *(_top_below(own, lowest, clouds[other]) for other in clouds if other != name)])


def _top_below(own: Points, lowest: float, other: Points) -> float:
    """Height of `other` where `own` stands on it [m], else 0.

    It carries where its top, beside the footprint of `own`, lies about at the lowest points of `own`, and some of
    that footprint lies within its outline.
    """
    low, high = own[:, :2].min(axis=0) - NEAR_M, own[:, :2].max(axis=0) + NEAR_M
    under = other[((other[:, :2] >= low) & (other[:, :2] <= high)).all(axis=1)]
    if len(under) < MIN_POINTS:
        return 0.0
    top = float(np.quantile(under[:, 2], 0.9))
    if not (top > TABLE_M and lowest - ABOVE_M <= top <= lowest + BELOW_M):
        return 0.0
    return top if _share_within(own[:, :2], other[:, :2]) >= MIN_OVERLAP else 0.0


def _share_within(points: Float64[np.ndarray, "n 2"], outline: Float64[np.ndarray, "m 2"]) -> float:
    """Part of the points that lie within the convex hull of others."""
    try:
        sides = ConvexHull(outline).equations
    except (QhullError, ValueError):
        return 0.0
    thinned = points[:: max(1, len(points) // 500)]
    return float((thinned @ sides[:, :2].T + sides[:, 2] <= 0.0).all(axis=1).mean())
