"""Underside of objects seen from above: sheets, bars, and all that reaches down to the support.

The picture shows the edges that face the camera, and under a raised edge the background: that tells the thickness
there. Narrow parts (handles, tines, blades) are mirrored about the height of their edges; wide parts with thin raised
edges are sheets of that thickness; all else reaches the support.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Vector3

MIN_THICKNESS_M = 0.002  # of a bar or a sheet [m]
BAR_HALF_WIDTH_M = 0.0125  # greatest half width of a bar [m]; wider parts are sheets or solids
BAR_SHAPE = 3.2  # most thickness of a bar in half widths: a thicker part stands, and is no bar
SHEET_SHARE, SHEET_M = 0.3, 0.008  # most thickness of a sheet's edge, in half widths and [m]: round bodies have more
SETTLED_M = 0.004  # height above the support up to which an edge rests on it [m]
FACING_COS = 0.1  # least cosine between an edge's outward direction and the camera: others hide their end
EDGES = 12  # nearest border columns, whose medians decide for a column
MEDIAN_CELLS = 5  # side of the square over which the underside is smoothed by medians
MIN_UPRIGHT_COS = 0.35  # between the vertical and the normal of the top: steeper slopes, from 70 degrees, count as this
SMOOTHING_CELLS = 1.5  # standard deviation by which tops and outlines are smoothed before their slope is measured
MARGIN_CELLS = 4  # around the footprint, for that smoothing
LEVELS = 12  # of the radius of discs

Map = Float64[np.ndarray, "nx ny"]
Cells = Bool[np.ndarray, "nx ny"]
Values = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class Footprint(Frozen):
    """Observations from above over a grid of columns with a spacing of `cell` [m]."""

    cell: float
    closed: Cells  # columns of the object
    top: Map  # highest point seen in each column, of the nearest one where none was [m]
    lowest: Map  # lowest point seen in each column, infinite where none was [m]
    empty_to: Map  # highest point below the top of each column that was seen empty, the support where none was [m]
    to_eye: Vector3  # direction to the camera, unit length


class _Edges(NamedTuple):
    """The visible border of a footprint, one entry per column."""

    at: Int64[np.ndarray, "n 2"]  # row and column
    raised: Values  # whether it was seen to end above the support
    bar: Values  # thickness, were the part a bar [m]
    twice_middle: Values  # top and bottom of such a bar together [m]
    sheet: Values  # thickness across it, were the part a sheet [m]


def estimate_underside(footprint: Footprint, support: float) -> Map:
    """Estimate the lower end of each column [m]; `support` is the height of the object's support [m]."""
    under = np.full(footprint.top.shape, support)
    width = compute_half_width(ndimage.distance_transform_edt(np.pad(footprint.closed, 1))[1:-1, 1:-1]) * footprint.cell
    upright = _compute_uprightness(footprint)
    edges = _find_edges(footprint, width, upright, support)
    if len(edges.at) == 0:
        return under
    inside = np.argwhere(footprint.closed)
    _, near = cKDTree(edges.at).query(inside, k=min(EDGES, len(edges.at)))
    near = np.reshape(near, (len(inside), -1))
    thick, twice, across = (np.median(of[near], axis=1) for of in (edges.bar, edges.twice_middle, edges.sheet))
    raised = edges.raised[near].mean(axis=1) > 0.5
    at = tuple(inside.T)
    half, top = width[at], footprint.top[at]
    bar = (half <= BAR_HALF_WIDTH_M) & (thick <= BAR_SHAPE * half)
    sheet = ~bar & raised & (across <= np.minimum(SHEET_SHARE * half, SHEET_M))
    mirrored = np.minimum(twice - top, top - MIN_THICKNESS_M)
    thin = top - np.maximum(across, MIN_THICKNESS_M) / upright[at]
    under[at] = np.maximum(np.where(bar, mirrored, np.where(sheet, thin, support)), support)
    return ndimage.median_filter(under, size=MEDIAN_CELLS)


def measure_raised_edge(footprint: Footprint, support: float) -> tuple[float, float]:
    """Measure the share of the visible border that ends above the support, and the thickness of a sheet there [m]."""
    width = compute_half_width(ndimage.distance_transform_edt(np.pad(footprint.closed, 1))[1:-1, 1:-1]) * footprint.cell
    edges = _find_edges(footprint, width, _compute_uprightness(footprint), support)
    raised = edges.raised > 0.0
    if not raised.any():
        return 0.0, 0.0
    # Of a rim that is round, with half the thickness as its radius, the line of sight leaves the lowest part unseen.
    seen_share = (1.0 + float(np.linalg.norm(footprint.to_eye[:2]))) / 2.0
    return float(raised.mean()), float(np.median(edges.sheet[raised])) / seen_share


def compute_half_width(inside: Map) -> Map:
    """Compute the radius of the largest disc in a shape that covers each cell, of each cell's distance to its border.

    Both are in cells; the distance is 0 outside.
    """
    result = inside.copy()
    for radius in np.linspace(0.0, float(inside.max()), LEVELS)[1:]:
        covered = ndimage.distance_transform_edt(inside < radius) < radius
        result = np.maximum(result, np.where(covered, radius, 0.0))
    return result


def _find_edges(footprint: Footprint, width: Map, upright: Map, support: float) -> _Edges:
    depth = ndimage.gaussian_filter(np.pad(footprint.closed.astype(float), MARGIN_CELLS), SMOOTHING_CELLS)
    slope = np.stack(np.gradient(depth), axis=-1)[MARGIN_CELLS:-MARGIN_CELLS, MARGIN_CELLS:-MARGIN_CELLS]
    length = np.maximum(np.linalg.norm(slope, axis=-1), 1e-9)
    level = float(np.linalg.norm(footprint.to_eye[:2]))
    facing = -(slope @ footprint.to_eye[:2]) / (length * max(level, 1e-9))
    border = footprint.closed & ~ndimage.binary_erosion(np.pad(footprint.closed, 1))[1:-1, 1:-1]
    lowest = ndimage.minimum_filter(footprint.lowest, size=3)
    at = np.argwhere(border & (facing > FACING_COS) & np.isfinite(lowest))
    here = tuple(at.T)
    inward = slope[here] / length[here][:, None]
    half, low = width[here], lowest[here]
    crest = _sample_inward(footprint, footprint.top, at, inward, np.minimum(half, BAR_HALF_WIDTH_M) / footprint.cell)
    rim = _sample_inward(footprint, footprint.top, at, inward, np.ones(len(at)))
    rise = footprint.to_eye[2] / np.maximum(level * facing[here], 1e-3)
    # A border column may stand just before a steep side: what was seen of the side below counts as well.
    low = np.minimum(low, footprint.empty_to[here])
    seen = np.maximum(crest - low, 0.0)
    # Of a round bar that line leaves this part of the radius below where it passes the border.
    part = 1.0 - (1.0 - np.sin(np.arctan(rise))) * np.sqrt(1.0 + rise**2)
    bottom = np.maximum(low - np.minimum(half, seen) * part, support)
    return _Edges(
        at=at,
        raised=(low > support + SETTLED_M).astype(float),
        bar=crest - bottom,
        twice_middle=crest + bottom,
        sheet=np.maximum(rim - low, 0.0) * upright[here],
    )


def _sample_inward(
    footprint: Footprint, heights: Map, at: Int64[np.ndarray, "n 2"], inward: Float64[np.ndarray, "n 2"], steps: Values
) -> Values:
    """Sample heights some steps inward from each border column [m]."""
    inner = np.rint(at + inward * steps[:, None]).astype(int)
    inner = np.clip(inner, 0, np.array(footprint.top.shape) - 1)
    inside = footprint.closed[tuple(inner.T)]
    return np.where(inside, heights[tuple(inner.T)], heights[tuple(at.T)])


def _compute_uprightness(footprint: Footprint) -> Map:
    weight = ndimage.gaussian_filter(footprint.closed.astype(float), SMOOTHING_CELLS)
    top = np.where(footprint.closed, footprint.top, 0.0)
    smooth = ndimage.gaussian_filter(top, SMOOTHING_CELLS) / np.maximum(weight, 1e-6)
    smooth = np.where(footprint.closed, smooth, footprint.top)
    along, across = np.gradient(smooth)
    return np.asarray(np.clip(1.0 / np.hypot(1.0, np.hypot(along, across) / footprint.cell), MIN_UPRIGHT_COS, 1.0))
