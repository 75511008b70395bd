"""Depth at the resolution of a model brought back to the picture, without points that hang between two surfaces."""

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy import ndimage

from schemas.geometry import DepthImage

STEP = 0.04
"""Neighbouring depths that differ by more than this share lie on two surfaces: a table seen at 10° from a metre and a
half away changes by 2.5 % from pixel to pixel of a model that works at 504."""


def brought_back(depth: DepthImage, width: int, height: int, *, smeared: bool = True) -> Float32[np.ndarray, "h w"]:
    """The depth at another size: smooth on a surface, and from one side or the other at a step, never from between.

    Networks smear steps over some pixels, and bilinear resizing does it again; points from there hang in the air
    between an object and what lies behind it. Those that the model gave are taken out, and no new ones are made: a
    pixel is interpolated only where all four around it lie on one surface, else it gets the nearest of them.

    Args:
        depth: Shape (h', w') [m]; 0 where there is none.
        width: Of the picture.
        height: Of the picture.
        smeared: Whether steps are smeared in it, as networks do; a sensor's readings are left as they are.
    """
    source = np.where(hanging(depth), 0.0, depth).astype(np.float32) if smeared else depth.astype(np.float32)
    if source.shape == (height, width):
        return source
    rows, columns = _positions(source.shape[0], height), _positions(source.shape[1], width)
    top, left = np.floor(rows).astype(np.intp), np.floor(columns).astype(np.intp)
    down, right = (rows - top).astype(np.float32)[:, None], (columns - left).astype(np.float32)[None, :]
    bottom = np.minimum(top + 1, source.shape[0] - 1)
    beside = np.minimum(left + 1, source.shape[1] - 1)
    corners = [source[np.ix_(y, x)] for y in (top, bottom) for x in (left, beside)]
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    above = corners[0] * (1 - right) + corners[1] * right
    below = corners[2] * (1 - right) + corners[3] * right
    smooth = above * (1 - down) + below * down
    nearest = source[np.ix_(np.rint(rows).astype(np.intp), np.rint(columns).astype(np.intp))]
    one_surface = (low > 0.0) & (high - low <= STEP * low)
    result: Float32[np.ndarray, "h w"] = np.where(one_surface, smooth, nearest)
    return result


def hanging(depth: DepthImage) -> Bool[np.ndarray, "h w"]:
    """Pixels with a step among their eight neighbours that lie on neither side of it."""
    known = depth > 0.0
    low = ndimage.minimum_filter(np.where(known, depth, np.inf), 3, mode="nearest")
    high = ndimage.maximum_filter(np.where(known, depth, 0.0), 3, mode="nearest")
    beside = STEP / 2 * depth
    between: Bool[np.ndarray, "h w"] = (
        known & (high > (1 + 2 * STEP) * low) & (depth - low > beside) & (high - depth > beside)
    )
    return between


def _positions(source: int, target: int) -> Float64[np.ndarray, " n"]:
    """Where the centres of the target's pixels lie among those of the source, which covers the same picture."""
    centres = (np.arange(target) + 0.5) * (source / target) - 0.5
    within: Float64[np.ndarray, " n"] = np.clip(centres, 0.0, source - 1.0)
    return within
