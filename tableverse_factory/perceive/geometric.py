"""The `geometric` detector and box segmenter: objects from depth alone, without weights."""

import numpy as np

from schemas.config import PerceiveConfig
from schemas.geometry import Camera, IdImage, Mask
from tableverse_factory.perceive.doors import Candidate, PixelBox
from tableverse_factory.perceive.regions import attached, merged, patches
from tableverse_factory.perceive.surface import surface_of
from tableverse_factory.perceive.view import TableView

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
    full = np.zeros(view.valid.shape, dtype=np.int32)
    if not view.raised.any():
        return full
    stride = max(1, int(np.ceil(np.sqrt(view.valid.size / WORKING_PIXELS))))
    rows, columns = _window(view.raised, stride)
    depth, raised = view.observation.depth[rows, columns], view.raised[rows, columns]
    camera = _window_camera(view.observation.camera, rows.start, columns.start, stride, raised.shape)
    typical = float(np.median(depth[raised]))
    pitch = typical / camera.fx
    surface = surface_of(depth, camera, typical)
    least = max(MIN_PIXELS, round(MIN_AREA_M2 / pitch**2))
    regions = attached(merged(patches(surface, raised, pitch), surface), surface, raised, least)
    large = np.kron(regions, np.ones((stride, stride), dtype=np.int32))
    target = full[rows.start : rows.start + large.shape[0], columns.start : columns.start + large.shape[1]]
    target[...] = large[: target.shape[0], : target.shape[1]]
    return full * view.raised


def _window(mask: Mask, stride: int) -> tuple[slice, slice]:
    """Rows and columns around the mask, every `stride`-th of them."""
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = MARGIN_PX * stride
    return (
        slice(max(int(ys[0]) - margin, 0), int(ys[-1]) + margin + 1, stride),
        slice(max(int(xs[0]) - margin, 0), int(xs[-1]) + margin + 1, stride),
    )


def _window_camera(camera: Camera, top: int, left: int, stride: int, shape: tuple[int, ...]) -> Camera:
    return Camera(
        camera.fx / stride,
        camera.fy / stride,
        (camera.cx - left) / stride,
        (camera.cy - top) / stride,
        shape[1],
        shape[0],
    )


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
