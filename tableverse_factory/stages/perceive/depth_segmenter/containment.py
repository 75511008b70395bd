"""Containment by outlines: contents of bowls, boxes and cups."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, IdImage, Mask
from tableverse_factory.geometry.math.planes import Points2, compute_convex_outline, is_inside_outline
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.depth_segmenter.vessel_floors import surrounds

SAMPLES = 1500  # pixels that stand for a larger region, or up to twice as many
MIN_OVER = 0.7  # least share of the content, and of its foot, that is over the holder's footprint
INSET_M = 0.01  # from the edge of that footprint, within which a content lies
BELOW_RIM_M = 0.02  # least height of the holder's rim over the lowest part of its content
FOOT_M = 0.01  # height of a content's foot over its lowest part; what surrounds the content as walls is higher


@dataclass(frozen=True, slots=True, eq=False)
class _RegionShape(Frozen):
    """Sample of a region over the table, its convex footprint, and the heights of its foot and its rim [m]."""

    size: int
    xy: Points2
    heights: Float64[np.ndarray, " n"]
    footprint: Points2
    low: float
    rim: float


def find_containers_by_outline(ids: IdImage, view: TableView) -> dict[int, int]:
    """Find the container of each region that lies in the hollow of another: the smallest one that qualifies."""
    shapes = {
        k: _describe_region(mask, view)
        for k in range(1, int(ids.max(initial=0)) + 1)
        if (mask := (ids == k) & view.valid).any()
    }
    holders: dict[int, int] = {}
    for inner, shape in shapes.items():
        around = [k for k, other in shapes.items() if other.size > shape.size and _lies_in(shape, other)]
        if around:
            holders[inner] = min(around, key=lambda k: shapes[k].size)
    return holders


def _describe_region(mask: Mask, view: TableView) -> _RegionShape:
    rows, columns = np.nonzero(mask)
    step = max(1, len(rows) // SAMPLES)
    rows, columns = rows[::step], columns[::step]
    xy, heights = view.xy(view.points_camera[rows, columns]), view.heights[rows, columns]
    low, rim = np.percentile(heights, (5, 98))
    return _RegionShape(int(mask.sum()), xy, heights, compute_convex_outline(xy), float(low), float(rim))


def _lies_in(inner: _RegionShape, holder: _RegionShape) -> bool:
    """Whether `inner` is over the holder's footprint, begins below its rim, and is surrounded by its walls.

    What lies below all that is seen of a holder carries it.
    """
    if inner.low > holder.rim - BELOW_RIM_M or inner.rim < holder.low:
        return False
    over = is_inside_outline(holder.footprint, inner.xy, -INSET_M)
    if min(float(over.mean()), float(over[inner.heights <= inner.low + FOOT_M].mean())) < MIN_OVER:
        return False
    walls = holder.xy[holder.heights > inner.low + FOOT_M]
    return len(walls) > 0 and surrounds(walls, inner.xy.mean(axis=0))
