"""Floors of plates, pans and bowls by colour: they are too near the table for depth."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from skimage.color import rgb2lab

from schemas.geometry import IdImage, Mask, Picture
from tableverse_factory.geometry.math.planes import Points2, compute_convex_outline, is_inside_outline
from tableverse_factory.stages.perceive.base.table_view import TableView

LAB_BINS = (6.0, 4.0, 4.0)  # of the histogram of the table's colours, in CIELAB
RARE_ON_TABLE = 0.03  # share of the table's own pixels whose colours are so rare on it that they may be a floor's
AWAY_PX = 6  # from what rises, of the pixels that tell the table's colours
MIN_TABLE_PIXELS = 2000  # of these
MIN_FLOOR_PIXELS = 150  # also of a part that rises around floors
MIN_ENCLOSED = 0.5  # least share of a floor's surroundings that rises or has no reading

TOUCHING_PX, NEAR_PX = 4, 10  # from a floor: what touches it, and where colours are compared with its own
MIN_TOUCH_PX = 8  # least number of a wall's pixels that touch its floor
CHROMA_BIN = 6.0  # of the histograms of a wall's and a floor's colours, in a and b of CIELAB
SAME_COLOR = 0.3  # least overlap of those histograms; 1 where they are equal
SAME_LIGHTNESS = 40.0  # most difference of their median lightness in CIELAB
SIDES, MIN_SIDES = 12, 8  # directions around what walls surround, and in how many of them walls are


def find_floors(view: TableView) -> IdImage:
    """Find patches of the table plane with another colour than the table, within the outline of what rises around them.

    Numbered from 1; 0 elsewhere. A dark patch may be a shadow: each is a proposal, see `is_wall_of_floor`.
    """
    result = np.zeros(view.valid.shape, dtype=np.int32)
    inside = _find_inside_outlines(view)
    table = view.on_plane & ~inside & ~ndimage.binary_dilation(view.raised, iterations=AWAY_PX)
    if not inside.any() or int(table.sum()) < MIN_TABLE_PIXELS:
        return result
    unlike = inside & _find_unlike_table(rgb2lab(view.observation.color), table)
    patches, count = ndimage.label(ndimage.binary_opening(unlike, np.ones((3, 3))))
    bounded = view.raised | ~view.valid
    for k, part in enumerate(ndimage.find_objects(patches, count), start=1):
        if part is None:
            continue
        window = tuple(slice(max(s.start - TOUCHING_PX, 0), s.stop + TOUCHING_PX) for s in part)
        mask = patches[window] == k
        rim = ndimage.binary_dilation(mask, iterations=TOUCHING_PX) & ~mask
        if int(mask.sum()) >= MIN_FLOOR_PIXELS and float(bounded[window][rim].mean()) >= MIN_ENCLOSED:
            result[window][mask] = int(result.max()) + 1
    return result


def _find_inside_outlines(view: TableView) -> Mask:
    """Find pixels of the plane over the convex footprint of a connected part of what rises."""
    inside = np.zeros(view.valid.shape, dtype=bool)
    parts, count = ndimage.label(view.raised)
    xy = view.xy(view.points_camera)
    for k, window in enumerate(ndimage.find_objects(parts, count), start=1):
        mask = parts[window] == k
        if int(mask.sum()) < MIN_FLOOR_PIXELS:
            continue
        outline = compute_convex_outline(xy[window][mask])
        inside[window] |= view.on_plane[window] & is_inside_outline(outline, xy[window])
    return inside


def _find_unlike_table(lab: Float64[np.ndarray, "h w 3"], table: Mask) -> Mask:
    """Find pixels whose colour is rarer on the table than all but a few per cent of the table's own pixels."""
    bins = np.floor((lab - np.array([0.0, -128.0, -128.0])) / np.array(LAB_BINS)).astype(np.int64)
    sizes = (int(100 / LAB_BINS[0]) + 2, int(256 / LAB_BINS[1]) + 2, int(256 / LAB_BINS[2]) + 2)
    index = np.ravel_multi_index(tuple(np.moveaxis(bins, -1, 0)), sizes, mode="clip")
    counts = np.bincount(index[table], minlength=int(np.prod(sizes))).astype(np.float64)
    density = ndimage.gaussian_filter(counts.reshape(sizes), 1.0).ravel()[index]
    return density < np.quantile(density[table], RARE_ON_TABLE)


def is_wall_of_floor(floor: Mask, region: Mask, color: Picture) -> bool:
    """Whether the region touches the floor and has its colour there: the wall of the same vessel."""
    near = region & ndimage.binary_dilation(floor, iterations=NEAR_PX)
    touching = region & ndimage.binary_dilation(floor, iterations=TOUCHING_PX)
    if int(touching.sum()) < MIN_TOUCH_PX:
        return False
    a, b = rgb2lab(color[floor][None])[0], rgb2lab(color[near][None])[0]
    if abs(float(np.median(a[:, 0]) - np.median(b[:, 0]))) > SAME_LIGHTNESS:
        return False
    return float(np.minimum(_build_chroma_histogram(a), _build_chroma_histogram(b)).sum()) >= SAME_COLOR


def surrounds(walls_xy: Points2, center_xy: Float64[np.ndarray, "2"]) -> bool:
    """Whether the walls stand in most directions around the centre; a shadow has its object on one side."""
    around = walls_xy - center_xy
    sectors = np.floor(np.arctan2(around[:, 1], around[:, 0]) / (2 * np.pi) * SIDES).astype(np.int64) % SIDES
    return len(np.unique(sectors)) >= MIN_SIDES


def _build_chroma_histogram(lab: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "44 44"]:
    """Build the smoothed histogram of a and b of CIELAB; sums to 1."""
    edges = np.arange(-132.0, 133.0, CHROMA_BIN)
    counts, _, _ = np.histogram2d(lab[:, 1], lab[:, 2], bins=(edges, edges))
    smooth: Float64[np.ndarray, "44 44"] = ndimage.gaussian_filter(counts, 0.7)
    return smooth / max(float(smooth.sum()), 1e-9)
