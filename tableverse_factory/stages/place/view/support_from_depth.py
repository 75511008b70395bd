"""Support of each object, the table or the top of another object, from the observed heights."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Frozen, Points, Pose
from schemas.objects import PerceivedObject
from tableverse_factory.geometry.math.planes import Points2
from tableverse_factory.geometry.math.transforms import transform_points

ABOVE_M = 0.03  # most height of an object's lowest visible points above its support [m]: its foot can be hidden
BELOW_M = 0.012  # most depth of them below it [m], for noise and flying pixels
TABLE_M = 0.012  # least height of a top above the table's noise [m]
NEAR_M = 0.01
MIN_POINTS = 20
MIN_OVERLAP = 0.1  # least share of an object's footprint within the outline of what carries it
# Of a carrier that is overhung: most of it that is hidden [m], least share of its top, so deep [m], under the overhang
NARROW_ABOVE_M, NARROW_OVERLAP, NARROW_TOP_M = 0.06, 0.6, 0.02
CONTAINER_FLOOR_M = 0.005  # height of the hidden floor of a container above the table [m]
LONG_RATIO = 2.5  # least length over breadth of contents that lean on the rim and reach the floor
STEEP_RATIO = 1.9  # the same of steep ones, which are more hidden
STEEP = 0.9  # least sine of the elevation of a steep object's longest axis
CORE = 0.5  # share of a supported object's footprint, about its middle, that has to be supported


@dataclass(frozen=True, slots=True, eq=False)
class DepthSupport(Frozen):
    """Support of one object, and what it supports, in the table frame."""

    height: float  # of the support [m]; 0 is the table
    carried: Points2  # corners of the middle part of the footprints of all that stands on the object [m]
    leaning: bool = False  # a long object in a container
    carrier: str | None = None  # the object on whose top it stands; None on the table or in a container
    ceiling: float = 0.0  # height of the lowest of what stands on the object [m]; 0 if nothing does


def find_supports(objects: Sequence[PerceivedObject], camera_to_table: Pose) -> dict[str, DepthSupport]:
    """Find the support of each object, by object id."""
    clouds = {o.object_id: transform_points(camera_to_table, o.points_camera) for o in objects}
    clouds = {name: cloud for name, cloud in clouds.items() if len(cloud) >= MIN_POINTS}
    heights = {o.object_id: 0.0 for o in objects}
    leaning = dict.fromkeys(heights, False)
    carriers: dict[str, str] = {}
    carried: dict[str, list[Points2]] = {name: [] for name in heights}
    for item in objects:
        cloud = clouds.get(item.object_id)
        if cloud is None:
            continue
        if item.contained_in is not None:
            leaning[item.object_id] = _is_long(cloud)
            heights[item.object_id] = CONTAINER_FLOOR_M if leaning[item.object_id] else _guess_bottom(cloud)
            continue
        lowest = float(np.quantile(cloud[:, 2], 0.02))
        below = {
            name: _find_top_below(cloud, lowest, other) for name, other in clouds.items() if name != item.object_id
        }
        carrier = max(below, key=lambda name: (below[name], name), default=None)
        if carrier is not None and below[carrier] > 0.0:
            heights[item.object_id], carriers[item.object_id] = below[carrier], carrier
            carried[carrier].append(_shrink_footprint(cloud[:, :2]))
    empty = np.zeros((0, 2))
    return {
        name: DepthSupport(
            heights[name],
            np.concatenate([empty, *carried[name]]),
            leaning[name],
            carriers.get(name),
            min((heights[above] for above, carrier in carriers.items() if carrier == name), default=0.0),
        )
        for name in heights
    }


def _find_top_below(own: Points, lowest: float, other: Points) -> float:
    """Find the height of `other` where `own`, whose foot is at the height `lowest`, stands on it [m], else 0.

    It is the support where its top, beside the footprint of `own`, lies about at the lowest points of `own`, and some
    of that footprint lies within its outline. `own` may also overhang a narrow one, which it hides in part: most of
    what is seen of its top lies within the footprint of `own`, whose bottom is seen.
    """
    within = np.ones(len(other), dtype=bool)
    for k in range(2):  # an axis at a time: numpy is slow on rows of two
        within &= (other[:, k] >= own[:, k].min() - NEAR_M) & (other[:, k] <= own[:, k].max() + NEAR_M)
    under = other[within]
    if len(under) < MIN_POINTS:
        return 0.0
    top = float(np.quantile(under[:, 2], 0.9))
    if not (top > TABLE_M and lowest - NARROW_ABOVE_M <= top <= lowest + BELOW_M):
        return 0.0
    if top >= lowest - ABOVE_M and _measure_share_within(own[:, :2], other[:, :2]) >= MIN_OVERLAP:
        return top
    upper = under[under[:, 2] >= top - NARROW_TOP_M, :2]
    return max(top, lowest) if _measure_share_within(upper, own[:, :2]) >= NARROW_OVERLAP else 0.0


def _measure_share_within(points: Points2, outline: Points2) -> float:
    """Measure the share of the points within the convex hull of others."""
    try:
        sides = ConvexHull(outline).equations
    except (QhullError, ValueError):
        return 0.0
    thinned = points[:: max(1, len(points) // 500)]
    return float((thinned @ sides[:, :2].T + sides[:, 2] <= 0.0).all(axis=1).mean())


def _shrink_footprint(footprint: Points2) -> Points2:
    """Compute the corners of the middle part of a footprint's box."""
    low, high = np.quantile(footprint, 0.02, axis=0), np.quantile(footprint, 0.98, axis=0)
    middle, half = (low + high) / 2, CORE * (high - low) / 2
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return middle + corners * half


def _is_long(cloud: Points) -> bool:
    _, spread, axes = np.linalg.svd(cloud - cloud.mean(axis=0), full_matrices=False)
    return bool(spread[0] > (STEEP_RATIO if abs(axes[0, 2]) > STEEP else LONG_RATIO) * spread[1])


def _guess_bottom(cloud: Points) -> float:
    """Guess the hidden bottom of contents [m]: no taller than broad, and not above what was seen."""
    low, high = np.quantile(cloud, 0.02, axis=0), np.quantile(cloud, 0.98, axis=0)
    guess = high[2] - float((high - low)[:2].max())
    return float(np.clip(guess, min(CONTAINER_FLOOR_M, max(low[2], 0.0)), max(low[2], 0.0)))
