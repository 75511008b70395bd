"""The `geometric` detector and box segmenter: objects from depth alone, without weights."""

import numpy as np
from scipy import ndimage

from schemas.config import PerceiveConfig
from schemas.geometry import IdImage, Mask
from tableverse_factory.perceive.doors import Candidate, PixelBox
from tableverse_factory.perceive.joins import joined
from tableverse_factory.perceive.membership import on_the_table
from tableverse_factory.perceive.regions import attached, merged, patches
from tableverse_factory.perceive.surface import surface_of
from tableverse_factory.perceive.view import TableView, back_through_window, through_window, working_window

WORKING_PIXELS = 350_000
MARGIN_PX = 12
MIN_AREA_M2 = 0.0003
MIN_PIXELS = 120


def geometric(view: TableView, config: PerceiveConfig, rng: np.random.Generator) -> tuple[Candidate, ...]:  # noqa: ARG001
    """Every region of `segment` as a candidate without a name."""
    regions = segment(view)
    return tuple(_candidate(regions == k) for k in range(1, int(regions.max(initial=0)) + 1))


def geometric_boxes(
    view: TableView,
    boxes: tuple[PixelBox, ...],
    config: PerceiveConfig,  # noqa: ARG001
    rng: np.random.Generator,  # noqa: ARG001
) -> tuple[Mask, ...]:
    """For each box the regions that lie mostly inside it."""
    regions = segment(view)
    return tuple(_regions_in(regions, box) for box in boxes)


def segment(view: TableView) -> IdImage:
    """Regions of the things that stand on the table, numbered from 1. Shape (h, w), 0 elsewhere."""
    if not view.raised.any():
        return np.zeros(view.valid.shape, dtype=np.int32)
    window = working_window(view.raised, WORKING_PIXELS, MARGIN_PX)
    part = through_window(view, window)
    typical = float(np.median(part.depth[part.raised]))
    pitch = typical / part.observation.camera.fx
    surface = surface_of(part.depth, part.observation.camera, typical)
    least = max(MIN_PIXELS, round(MIN_AREA_M2 / pitch**2))
    regions = attached(merged(patches(surface, part.raised, pitch), surface), surface, part.raised, least)
    regions = joined(on_the_table(regions, part), surface, part)
    measured = ndimage.binary_closing(np.pad(view.observation.depth > 0, 1), np.ones((3, 3)))[1:-1, 1:-1]
    return back_through_window(regions, window, view.valid.shape) * measured


def _candidate(mask: Mask) -> Candidate:
    return Candidate("object", 1.0, mask_box(mask), mask)


def mask_box(mask: Mask) -> PixelBox:
    """The tightest box around a mask that is not empty."""
    rows, columns = np.nonzero(mask)
    return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)


def _regions_in(regions: IdImage, box: PixelBox) -> Mask:
    x0, y0, x1, y1 = (round(v) for v in box)
    window = regions[y0:y1, x0:x1]
    sizes = np.bincount(regions.ravel())
    inside = np.bincount(window.ravel(), minlength=len(sizes))
    chosen = inside > 0.6 * np.maximum(sizes, 1)
    chosen[0] = False
    mask: Mask = chosen[regions]
    return mask
