"""How much of what stands above the table the objects explain, whatever found them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.geometry import IdImage, Mask
from schemas.objects import Explanation, PerceivedObject
from tableverse_factory.geometry.math.planes import (
    Points2,
    compute_convex_outline,
    measure_depth_inside,
)
from tableverse_factory.stages.perceive.base.object_filter import (
    find_over_table,
    keep_objects,
    keep_regions_over_table,
)
from tableverse_factory.stages.perceive.base.table_view import (
    ImageWindow,
    TableView,
    compute_depth_noise,
    crop_view,
)

MAX_PIXELS = 100_000  # of the picture as it is looked at
TOUCHING_M = 0.01  # nearer neighbours in the picture are of one piece, besides twice the width of their pixels
LEVEL_M, LEVEL_NOISES = 0.01, 5.0  # height of the table's own readings, the larger of it and of this many deviations
MIN_PATCH_M2, FARTHEST_PATCH_M = 0.02, 0.6  # of a part of the table behind a pile
CORE_PX = 7  # narrower strips are where an upright face crosses the table's height


def measure_explanation(
    view: TableView, ids: IdImage, objects: Sequence[PerceivedObject], shown: Mask | None = None
) -> Explanation:
    """Measure what stands above the table by the sensor's own readings, and the part of each object.

    It is what is raised over the outline of the table, with the parts of the table that a pile cuts off, but not what
    mostly stands beside it, such as a wall, or hangs there. A detector that uses our net says which pixels count,
    `shown`: of a sensor's depth those that are raised and surely no arm or background, of a model's, which is bent,
    those that the net takes for objects, found or not.
    """
    height, width = ids.shape
    stride = int(np.ceil(np.sqrt(ids.size / MAX_PIXELS)))
    window = ImageWindow(0, 0, height // stride, width // stride, stride)
    part, own = crop_view(view, window), ids[window.slices]
    areas = _measure_pixel_areas(part)
    by_depth = view.observation.bend == 0.0
    standing = _find_standing(part, areas, part.raised if shown is None else shown[window.slices], by_depth=by_depth)
    shares = [standing & (own == item.instance_id) for item in objects]
    return Explanation(
        points=int(standing.sum()) * stride**2,
        area_m2=float(areas[standing].sum()),
        of_objects=tuple(
            (item.object_id, int(share.sum()) * stride**2, float(areas[share].sum()))
            for item, share in zip(objects, shares, strict=True)
        ),
    )


def _measure_pixel_areas(view: TableView) -> Float64[np.ndarray, "h w"]:
    """Measure the area of each pixel across the line of sight [m²]; 0 without a reading."""
    camera = view.observation.camera
    return np.asarray(view.observation.depth, dtype=np.float64) ** 2 / (camera.fx * camera.fy)


def _find_standing(view: TableView, areas: Float64[np.ndarray, "h w"], raised: Mask, *, by_depth: bool) -> Mask:
    """Find what is raised and over the table, less the pieces that are no objects by the segmenter's own filters."""
    whole = replace(view, outline_xy=_extend_outline(view, areas))
    labelled = keep_regions_over_table(_label_pieces(raised & (areas > 0.0), view), whole)
    pieces = keep_objects(labelled, whole, by_depth=by_depth)
    return (pieces > 0) & find_over_table(whole)


def _label_pieces(mask: Mask, view: TableView) -> IdImage:
    """Number the pieces of a mask from 1, split where neighbouring readings lie apart; 0 elsewhere."""
    number = np.zeros(mask.shape, dtype=np.int32)
    number[mask] = np.arange(int(mask.sum()))
    reach = TOUCHING_M + 2 * view.depth / view.observation.camera.fx
    ends = []
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        gap = np.linalg.norm(view.points_camera[first] - view.points_camera[second], axis=-1)
        near = mask[first] & mask[second] & (gap < reach[first])
        ends.append((number[first][near], number[second][near]))
    rows, columns = (np.concatenate(sides) for sides in zip(*ends, strict=True))
    graph = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(int(mask.sum()),) * 2)
    number[mask] = connected_components(graph, directed=False)[1] + 1
    return number


def _extend_outline(view: TableView, areas: Float64[np.ndarray, "h w"]) -> Points2:
    """Extend the outline of the table to parts that lie beyond it, cut off by what stands on the table."""
    level = np.maximum(LEVEL_M, LEVEL_NOISES * compute_depth_noise(view.depth))
    core = ndimage.binary_opening((areas > 0.0) & (np.abs(view.heights) <= level), np.ones((CORE_PX, CORE_PX)))
    patch, count = ndimage.label(core)
    depth_over = measure_depth_inside(view.outline_xy, view.xy(view.points_camera))
    large = np.bincount(patch[core], areas[core], count + 1) >= MIN_PATCH_M2
    near = np.bincount(patch[core & (depth_over > -FARTHEST_PATCH_M)], minlength=count + 1) > 0
    sizes, inside = (np.bincount(patch[its], minlength=count + 1) for its in (core, core & (depth_over >= 0.0)))
    beyond = core & (large & near & (2 * inside < sizes))[patch]
    return compute_convex_outline(np.concatenate([view.outline_xy, view.xy(view.points_camera)[beyond]]))
