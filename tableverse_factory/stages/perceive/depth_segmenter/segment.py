"""The `geometric` detector and box segmenter: objects from depth alone, without weights."""

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from schemas.config import Config
from schemas.geometry import IdImage
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.box_overlap import compute_area
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult, PixelBox
from tableverse_factory.stages.perceive.base.object_filter import (
    drop_unseen_regions,
    keep_objects,
    keep_regions_over_table,
    renumber_regions,
)
from tableverse_factory.stages.perceive.base.table_view import TableView, crop_view, find_working_window, uncrop_ids
from tableverse_factory.stages.perceive.depth_segmenter.merge_regions import merge_occluded_parts
from tableverse_factory.stages.perceive.depth_segmenter.oversegment import (
    attach_border_pixels,
    merge_patches,
    oversegment,
)
from tableverse_factory.stages.perceive.depth_segmenter.rims import find_rims
from tableverse_factory.stages.perceive.depth_segmenter.surface import compute_surface
from tableverse_factory.stages.perceive.depth_segmenter.vessels import (
    add_insides,
    find_containers,
    find_rising_contents,
    merge_vessel_walls,
)

WORKING_PIXELS = 350_000  # of a picture: larger ones are thinned to it
MARGIN_PX = 12  # around what rises, of the part of the picture that is looked at
MIN_CORE_M2, MIN_PIXELS = 0.0003, 120  # least area and pixels of a region
MOSTLY_INSIDE = 0.6  # share of a region from which it is in a box
MAX_HOLE_PX = 60  # larger holes are no lost readings


def detect_from_depth(view: TableView, _config: Config, _services: Services) -> DetectionResult:
    """Detect every region of `segment_depth` as an unnamed candidate, the largest in the picture first."""
    return to_detections(*segment_depth(view))


def segment_boxes_from_depth(view: TableView, found: DetectionResult, _config: Config) -> IdImage:
    """Assign to each box the regions mostly in it and in no smaller box; else its part of the one it overlaps most.

    Of two boxes with the same pixel the smaller one has it: contents lie in the box of their container.
    """
    return assign_regions_to_boxes(segment_depth(view)[0], found)


def assign_regions_to_boxes(regions: IdImage, found: DetectionResult) -> IdImage:
    """Return an image of `k + 1` in the regions of the k-th box, as `segment_boxes_from_depth` assigns them."""
    if not found.candidates:
        return np.zeros_like(regions)
    sizes = np.bincount(regions.ravel())
    parts = [_slice_box(candidate.box, regions.shape) for candidate in found.candidates]
    counts = np.array([np.bincount(regions[part].ravel(), minlength=len(sizes)) for part in parts])
    counts[:, 0] = 0
    areas = np.array([compute_area(candidate.box) for candidate in found.candidates])
    owner = np.where(counts / np.maximum(sizes, 1) >= MOSTLY_INSIDE, areas[:, None], np.inf)
    wanted = (owner == owner.min(axis=0)) & np.isfinite(owner)
    owner_of = np.where(wanted.any(axis=0), wanted.argmax(axis=0) + 1, 0).astype(np.int32)
    ids: IdImage = owner_of[regions]
    for k in np.argsort(-areas, kind="stable"):
        if not wanted[k].any():
            wanted[k, counts[k].argmax()] = counts[k].any()
        ids[parts[k]][wanted[k][regions[parts[k]]]] = k + 1
    return ids


def compute_least_pixels(pitch_m: float) -> int:
    """Compute the pixels of the smallest region that is kept, where a pixel is `pitch_m` wide."""
    return max(MIN_PIXELS, round(MIN_CORE_M2 / pitch_m**2))


def segment_depth(view: TableView) -> tuple[IdImage, dict[int, int]]:
    """Segment the objects on the table, ids from 1, the largest first; and find the container of each that has one."""
    if not view.raised.any():
        return np.zeros(view.valid.shape, dtype=np.int32), {}
    window = find_working_window(view.raised, WORKING_PIXELS, MARGIN_PX)
    part = crop_view(view, window)
    if not part.raised.any():  # what is raised lies between the pixels of a large picture that are looked at
        return np.zeros(view.valid.shape, dtype=np.int32), {}
    typical = float(np.median(part.depth[part.raised]))
    pitch = typical / part.observation.camera.fx
    surface = compute_surface(part.depth, part.observation.camera, typical)
    least = compute_least_pixels(pitch)
    patches = merge_patches(oversegment(surface.borders, part.raised, pitch), surface)
    regions = attach_border_pixels(patches, surface, part.raised, least)
    regions = keep_regions_over_table(regions, part)
    regions = merge_occluded_parts(regions, surface, part)
    openings = find_rims(regions, part)
    regions = merge_vessel_walls(regions, openings, surface, part, least)
    regions = keep_objects(regions, part, find_rising_contents(regions, openings, part))
    regions = drop_unseen_regions(regions, part)
    regions = add_insides(regions, openings, part)
    sizes = np.bincount(regions.ravel())[1:]
    regions = renumber_regions(regions, [int(k) + 1 for k in np.argsort(-sizes, kind="stable")])
    measured = ndimage.binary_closing(np.pad(view.observation.depth > 0, 1), np.ones((3, 3)))[1:-1, 1:-1]
    full = uncrop_ids(regions, window, view.valid.shape) * measured
    return fill_holes(full), find_containers(regions, openings, part)


def fill_holes(ids: IdImage) -> IdImage:
    """Fill small holes, such as lost readings leave, where only one id surrounds them."""
    holes, count = ndimage.label(ids == 0)
    sizes = np.bincount(holes.ravel(), minlength=count + 1)
    result = ids.copy()
    for k, window in enumerate(ndimage.find_objects(holes), start=1):
        if window is None or sizes[k] > MAX_HOLE_PX:
            continue
        wider = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in window)
        hole = holes[wider] == k
        around = np.unique(ids[wider][ndimage.binary_dilation(hole) & ~hole])
        if len(around) == 1:
            result[wider][hole] = around[0]
    return result


def to_detections(ids: IdImage, holders: Mapping[int, int]) -> DetectionResult:
    """Turn the result of `segment_depth` into candidates without names, in the order of their ids."""
    boxes = enumerate(map(to_box, ndimage.find_objects(ids)), start=1)
    things = (Candidate("object", 1.0, box, k, holders[k] - 1 if k in holders else None) for k, box in boxes)
    return DetectionResult(tuple(things), ids=ids)


def to_box(window: tuple[slice, slice] | None) -> PixelBox:
    """Convert a window to a box; all zero for an id without pixels."""
    rows, columns = window or (slice(0, 0), slice(0, 0))
    return float(columns.start), float(rows.start), float(columns.stop), float(rows.stop)


def _slice_box(box: PixelBox, shape: tuple[int, ...]) -> tuple[slice, slice]:
    x0, y0, x1, y1 = (max(round(v), 0) for v in box)
    return slice(min(y0, shape[0]), min(y1, shape[0])), slice(min(x0, shape[1]), min(x1, shape[1]))
