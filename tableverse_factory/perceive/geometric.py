"""The `geometric` detector and box segmenter: objects from depth alone, without weights."""

import numpy as np
from jaxtyping import Int64
from scipy import ndimage

from schemas.config import Config, PerceiveConfig
from schemas.geometry import IdImage, Mask
from tableverse_factory.perceive.doors import Boxes, Candidate, Found, Masks, PixelBox
from tableverse_factory.perceive.joins import joined
from tableverse_factory.perceive.membership import over_the_table, renumbered, things
from tableverse_factory.perceive.regions import attached, merged, patches
from tableverse_factory.perceive.rims import rims
from tableverse_factory.perceive.surface import surface_of
from tableverse_factory.perceive.vessels import what_holds, whole_vessels, with_insides
from tableverse_factory.perceive.view import TableView, back_through_window, through_window, working_window
from tableverse_factory.services import Services

WORKING_PIXELS = 350_000
MARGIN_PX = 12
MIN_CORE_M2 = 0.0003
MIN_PIXELS = 120
MOSTLY_INSIDE = 0.6
MAX_HOLE_PX = 60


def geometric(
    view: TableView,
    config: PerceiveConfig,  # noqa: ARG001
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,  # noqa: ARG001
) -> Found:
    """Every region of `segment` as a candidate without a name, the largest in the picture first."""
    regions, holders = segment(view)
    masks = [regions == k for k in range(1, int(regions.max(initial=0)) + 1)]
    return Found(
        tuple(
            Candidate("object", 1.0, mask_box(mask), mask, holders[k] - 1 if k in holders else None)
            for k, mask in enumerate(masks, start=1)
        )
    )


def geometric_boxes(
    view: TableView,
    boxes: Boxes,
    config: Config,  # noqa: ARG001
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,  # noqa: ARG001
) -> Masks:
    """For each box the regions that lie mostly in it and in no smaller box; else its part of the one it meets most."""
    regions, _ = segment(view)
    sizes = np.bincount(regions.ravel())
    shares = np.array([_counts(regions, box, len(sizes)) / np.maximum(sizes, 1) for box in boxes.objects])
    areas = np.array([(box[2] - box[0]) * (box[3] - box[1]) for box in boxes.objects])
    owner = np.where(shares >= MOSTLY_INSIDE, areas[:, None], np.inf)
    owned = (owner == owner.min(axis=0)) & np.isfinite(owner)
    owned[:, 0] = False
    masks = []
    for k, box in enumerate(boxes.objects):
        mask = owned[k][regions]
        if not mask.any():
            counts = _counts(regions, box, len(sizes))
            counts[0] = 0
            mask = np.zeros(regions.shape, dtype=bool)
            part = _inside(box, regions.shape)
            mask[part] = (regions[part] == int(np.argmax(counts))) & bool(counts.any())
        masks.append(mask)
    return Masks(tuple(masks))


def segment(view: TableView) -> tuple[IdImage, dict[int, int]]:
    """The things that stand on the table, and which lies in which.

    Returns:
        Ids numbered from 1, the largest first, shape (h, w), 0 elsewhere; and for each id that lies in another's
        hollow that other.
    """
    if not view.raised.any():
        return np.zeros(view.valid.shape, dtype=np.int32), {}
    window = working_window(view.raised, WORKING_PIXELS, MARGIN_PX)
    part = through_window(view, window)
    typical = float(np.median(part.depth[part.raised]))
    pitch = typical / part.observation.camera.fx
    surface = surface_of(part.depth, part.observation.camera, typical)
    least = max(MIN_PIXELS, round(MIN_CORE_M2 / pitch**2))
    regions = attached(merged(patches(surface, part.raised, pitch), surface), surface, part.raised, least)
    regions = joined(over_the_table(regions, part), surface, part)
    openings = rims(regions, part)
    regions = with_insides(things(whole_vessels(regions, openings, surface, part), part), openings, part)
    sizes = np.bincount(regions.ravel())[1:]
    regions = renumbered(regions, [int(k) + 1 for k in np.argsort(-sizes, kind="stable")])
    measured = ndimage.binary_closing(np.pad(view.observation.depth > 0, 1), np.ones((3, 3)))[1:-1, 1:-1]
    full = back_through_window(regions, window, view.valid.shape) * measured
    return without_holes(full), what_holds(regions, openings, part)


def without_holes(ids: IdImage) -> IdImage:
    """The ids with small holes, such as lost readings leave, filled where only one id surrounds them."""
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


def mask_box(mask: Mask) -> PixelBox:
    """The tightest box around a mask that is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


def _inside(box: PixelBox, shape: tuple[int, ...]) -> tuple[slice, slice]:
    x0, y0, x1, y1 = (max(round(v), 0) for v in box)
    return slice(min(y0, shape[0]), min(y1, shape[0])), slice(min(x0, shape[1]), min(x1, shape[1]))


def _counts(regions: IdImage, box: PixelBox, count: int) -> Int64[np.ndarray, " k"]:
    """Pixels of each id inside the box."""
    counts: Int64[np.ndarray, " k"] = np.bincount(regions[_inside(box, regions.shape)].ravel(), minlength=count)
    return counts
