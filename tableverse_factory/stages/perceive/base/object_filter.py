"""Filters that keep regions of objects on the table: no walls, no table edge, no furniture behind."""

from collections.abc import Collection

import numpy as np
from scipy import ndimage

from schemas.geometry import IdImage, Mask
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.color_edges import FAINT_EDGE, blur_to_lab, measure_color_edges
from tableverse_factory.geometry.math.planes import is_inside_outline
from tableverse_factory.stages.perceive.base.table_view import TableView, compute_depth_noise, expand_window

EDGE_M = 0.01  # a wall at the table's edge is read on both sides of it
MIN_OVER_TABLE = 0.3
MIN_AREA_M2, MIN_CONTENT_AREA_M2 = 0.00045, 0.0002
NOISE_AT_HALF_A_METRE_M = 0.0012
HANGING_M = 0.04
BENDS = 2.0  # height below the table at which a model's depth, which is bent, may show what stands on it, in bends
BELOW_PX = 4
CONTACT_M = 0.025
MIN_CARRIED = 0.1
FLAT_M = 0.02
RAGGED_EDGE_M = 0.03
SMALL_AREA_M2 = 0.003  # of a region that may be an error of the depth [m²]
UNSEEN_COLOR = 5.0  # median colour of a region that is that beside it, in CIELAB: 0.9 to 3.7 of three false objects
SATURATED = 98.0  # lightness from which the picture tells nothing
SURROUNDINGS_PX = 12


def keep_regions_over_table(ids: IdImage, view: TableView) -> IdImage:
    """Keep the regions over the table's outline, renumbered from 1: no wall, no floor, no other table."""
    sizes = np.bincount(ids[view.valid], minlength=int(ids.max(initial=0)) + 1)
    inside = np.bincount(ids[find_over_table(view)], minlength=len(sizes))
    return renumber_regions(ids, [k for k in range(1, len(sizes)) if inside[k] >= MIN_OVER_TABLE * sizes[k] > 0])


def find_over_table(view: TableView) -> Mask:
    """Find readings inside the table's outline, or over a part of the table that lies below the picture."""
    xy = view.xy(view.points_camera)
    return view.valid & (is_inside_outline(view.outline_xy, xy, -EDGE_M) | _find_feet_below_image(view))


def keep_objects(ids: IdImage, view: TableView, contents: Collection[int] = (), *, by_depth: bool = True) -> IdImage:
    """Keep the regions that are large enough and supported, renumbered from 1.

    `contents`, which stand in the opening of a vessel, may be smaller: no table is there for noise to raise. Far
    regions found `by_depth` must be larger, as the noise of a sensor grows; those that a net sees need not.
    """
    inner = is_inside_outline(view.outline_xy, view.xy(view.points_camera), -RAGGED_EDGE_M)
    kept = []
    for k in range(1, int(ids.max(initial=0)) + 1):
        mask = (ids == k) & view.valid
        least = MIN_CONTENT_AREA_M2 if k in contents else MIN_AREA_M2
        if (
            _is_large_enough(mask, view, least, by_depth=by_depth)
            and _is_carried(mask, ids, view)
            and not _is_ragged_edge(mask, inner, view)
        ):
            kept.append(k)
    return renumber_regions(ids, kept)


def drop_unseen_regions(ids: IdImage, view: TableView) -> IdImage:
    """Drop small regions that only the depth tells of, renumbered from 1: gloss makes a sensor read what is not there.

    The picture shows no edge to what they border on, and their colour is that of what lies around them.
    """
    count = int(ids.max(initial=0))
    return renumber_regions(ids, [k for k in range(1, count + 1) if not _is_unseen(ids, k, view)])


def _is_unseen(ids: IdImage, k: int, view: TableView) -> bool:
    region = ids == k
    if not region.any() or _measure_area(region & view.valid, view) >= SMALL_AREA_M2:
        return False
    window = expand_window(region, SURROUNDINGS_PX)
    own, others = region[window], ids[window] > 0
    lab = blur_to_lab(view.observation.color[window])
    edges = [measure_color_edges(own.astype(np.int32), 1, lab, side)[0] for side in (~others, others & ~own)]
    known = [edge for edge in edges if np.isfinite(edge)]
    around = ~own & ndimage.binary_dilation(own, iterations=SURROUNDINGS_PX)
    shown, beside = (np.median(lab[pixels], axis=0) for pixels in (own, around))
    alike = bool(np.linalg.norm(shown - beside) <= UNSEEN_COLOR and shown[0] < SATURATED)
    return alike and bool(known) and max(known) <= FAINT_EDGE  # an edge that is not known may be one


def renumber_regions(ids: IdImage, kept: list[int]) -> IdImage:
    """Renumber the kept ids as 1, 2, … in the order given; the others become 0."""
    number = np.zeros(int(ids.max(initial=0)) + 1, dtype=np.int32)
    number[kept] = np.arange(1, len(kept) + 1)
    return number[ids]


def _measure_area(mask: Mask, view: TableView) -> float:
    """Measure the region's area across the line of sight at its distance [m²]."""
    camera = view.observation.camera
    return float(np.sum(view.depth[mask] ** 2)) / (camera.fx * camera.fy)


def _is_large_enough(mask: Mask, view: TableView, least_m2: float, *, by_depth: bool) -> bool:
    """Whether the region is larger than what noise alone raises: at its distance if found `by_depth`, else nearby."""
    if not mask.any():
        return False
    noise = float(compute_depth_noise(np.median(view.depth[mask]))) if by_depth else NOISE_AT_HALF_A_METRE_M
    return _measure_area(mask, view) >= least_m2 * (noise / NOISE_AT_HALF_A_METRE_M) ** 2


def _find_feet_below_image(view: TableView) -> Mask:
    """Find pixels whose foot on the table lies below the picture, where the table may well continue."""
    feet = view.points_camera - view.heights[..., None] * view.plane.normal
    rows = project(feet.reshape(-1, 3), view.observation.camera)[:, 1].reshape(view.valid.shape)
    return np.nan_to_num(rows, nan=np.inf) > view.valid.shape[0] - 1


def _is_carried(mask: Mask, ids: IdImage, view: TableView) -> bool:
    """Whether the region is near the table or has a visible or hidden support, and does not stand below, on a floor.

    Below its lower contour, at the next reading, are the table, a surface that it touches, or something nearer that may
    hide its support; where nothing more is read down to the border of the picture, its support may be there. What rises
    there beyond the table, in no region of `ids`, is a wall or furniture: a rail on it is no object.
    """
    low, middle = np.percentile(view.heights[mask], (2, 50))
    if middle < -max(HANGING_M, BENDS * view.observation.bend * float(np.median(view.depth[mask]))):
        return False
    if low < HANGING_M:
        return True
    columns = np.flatnonzero(mask.any(axis=0))
    lowest = mask.shape[0] - 1 - np.argmax(mask[::-1, columns], axis=0)
    below = _find_next_reading(view.valid, lowest + BELOW_PX, columns)
    at_border = below >= mask.shape[0]
    below = np.minimum(below, mask.shape[0] - 1)
    points, under = view.points_camera[lowest, columns], view.points_camera[below, columns]
    touches = np.linalg.norm(points - under, axis=1) < CONTACT_M
    seen = (ids[below, columns] > 0) | ~view.raised[below, columns]
    carried = at_border | (seen & (touches | view.on_plane[below, columns] | (under[:, 2] < points[:, 2])))
    return float(carried.mean()) >= MIN_CARRIED


def _find_next_reading(valid: Mask, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Find the first row from each of `rows` downwards with a reading in its column; the height where there is none.

    Sensors read nothing beside the edges of objects, often over more pixels than a filter looks past.
    """
    height = valid.shape[0]
    own = np.pad(valid[:, columns], ((0, 1), (0, 0)), constant_values=True)
    from_rows = own & (np.arange(height + 1)[:, None] >= np.minimum(rows, height))
    return np.argmax(from_rows, axis=0)


def _is_ragged_edge(mask: Mask, inner: Mask, view: TableView) -> bool:
    """Whether the region is a small flat piece at the table's edge, where sensors bend the plane."""
    flat = float(np.percentile(view.heights[mask], 95)) < FLAT_M
    return flat and _measure_area(mask, view) < SMALL_AREA_M2 and float(inner[mask].mean()) < 0.5
