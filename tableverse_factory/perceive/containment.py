"""What lies in what: contents of bowls, boxes and cups, by their shapes alone."""

import numpy as np

from schemas.geometry import IdImage, Mask
from tableverse_factory.geometry.planes import convex_outline, inside_outline
from tableverse_factory.perceive.hollows import surrounds
from tableverse_factory.perceive.view import TableView

OVER = 0.7
BELOW_RIM_M = 0.01


def containers(ids: IdImage, view: TableView) -> dict[int, int]:
    """For each region that lies in the hollow of another, that other: the smallest one that qualifies."""
    masks = {k: (ids == k) & view.valid for k in range(1, int(ids.max(initial=0)) + 1)}
    sizes = {k: int(mask.sum()) for k, mask in masks.items()}
    holders: dict[int, int] = {}
    for inner, mask in masks.items():
        around = [k for k in masks if sizes[k] > sizes[inner] and lies_in(mask, masks[k], view)]
        if around:
            holders[inner] = min(around, key=lambda k: sizes[k])
    return holders


def lies_in(inner: Mask, holder: Mask, view: TableView) -> bool:
    """Whether `inner` is over the holder's footprint, begins below its rim, and has its walls all around."""
    if not inner.any() or not holder.any():
        return False
    low = float(np.percentile(view.heights[inner], 5))
    rim = float(np.percentile(view.heights[holder], 98))
    if low > rim - BELOW_RIM_M:
        return False
    inner_xy, holder_xy = view.xy(view.points_camera[inner]), view.xy(view.points_camera[holder])
    if float(inside_outline(convex_outline(holder_xy), inner_xy).mean()) < OVER:
        return False
    walls = holder_xy[view.heights[holder] > low]
    return len(walls) > 0 and surrounds(walls, inner_xy.mean(axis=0))
