"""Scale of an observation by a known length: measured in its depth, and applied to it or compared with a sensor's."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from schemas.geometry import IdImage, Mask
from schemas.known_length import KnownCameraHeight, KnownDistance, KnownHeight, KnownSheet, get_pixel_std
from schemas.observation import Observation
from schemas.outcome import Dropped
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.math.planes import Plane
from tableverse_factory.stages.perceive.base.interfaces import Candidate
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.scale.surface import (
    LENGTH_STD_M,
    UNMEASURED,
    MeasuredLength,
    measure_distance,
    measure_sheet,
)
from tableverse_factory.stages.perceive.table import find_table

SMALLEST, LARGEST = 0.2, 5.0  # plausible factors between a depth model's scale and the true one
MAX_SIGMA = 0.15
SENSOR_TOLERANCE, SENSOR_SIGMAS = 0.05, 3.0  # by how much a known length may differ from a sensor's depth
CAMERA_STD_M = 0.01  # of the place of the lens within a camera whose height was measured
TOP_PERCENTILE = 98.0
RING = 0.03  # width of the table around an object on which its height is measured, in longer sides
MIN_RING_PIXELS = 50
MIN_OBJECT_HEIGHT_M = 0.002


@dataclass(frozen=True, slots=True)
class ScaleFactor:
    """Factor from an observation's depth to metres, and the standard deviation of its logarithm."""

    value: float
    sigma: float


def find_scaled_table(
    item: Observation, rng: np.random.Generator, table_top: Mask | None = None
) -> TableView | Dropped:
    """Find the table in the scale of the known length; heights over the table wait for `scale_by_height`.

    The table lies among the pixels `table_top`, None for all. The scene is dropped for `known_length_unmeasured`,
    `scale_implausible` or `scale_contradicts_sensor`.
    """
    try:
        return _find_scaled_table(item, rng, table_top)
    except InputError as error:
        return Dropped(error.reason, str(error))


def _find_scaled_table(item: Observation, rng: np.random.Generator, table_top: Mask | None) -> TableView | Dropped:
    known = item.known_length
    if isinstance(known, KnownDistance):
        item = _scale(item, compute_factor(item, known.length_m, measure_distance(item, known)))
    elif isinstance(known, KnownSheet):
        item = _scale(item, compute_factor(item, known.size_m[0], measure_sheet(item, known)))
    view = find_table(item, rng, table_top)
    if isinstance(view, Dropped) or not isinstance(known, KnownCameraHeight) or item.scale_source == "sensor":
        return view
    value = known.length_m / measure_camera_height(view, known).length_m  # of this plane; detectors may find another
    if not SMALLEST <= value <= LARGEST:
        return view
    return find_table(replace(item, depth=item.depth * np.float32(value)), rng, table_top)


def scale_by_height(
    view: TableView, item: Observation, candidates: tuple[Candidate, ...], ids: IdImage
) -> TableView | Dropped:
    """Scale a view by the known height of one of its objects, or of the camera, over the table that was found at last.

    `item` is the observation as it came: the factor is of its depth. Dropped as in `find_scaled_table`.
    """
    known, ratio = item.known_length, _compare_depth(item, view.observation)
    try:
        if isinstance(known, KnownCameraHeight):
            measured = measure_camera_height(view, known)
        elif isinstance(known, KnownHeight):
            measured = measure_object_height(view, known, _find_object(known, candidates, ids, view.valid))
        else:
            return view
        factor = compute_factor(item, known.length_m, replace(measured, length_m=measured.length_m * ratio))
    except InputError as error:
        return Dropped(error.reason, str(error))
    if factor is None:
        return view
    value = factor.value * ratio
    return replace(
        view,
        observation=_scale(item, factor),
        points_camera=view.points_camera * value,
        plane=Plane(view.plane.normal, view.plane.offset * value),
        outline_xy=view.outline_xy * value,
        heights=view.heights * value,
    )


def _compare_depth(item: Observation, scaled: Observation) -> float:
    """Compare the depth of an observation with that of the same one in another scale, as a ratio."""
    at = np.unravel_index(int(np.argmax(scaled.depth)), scaled.depth.shape)
    return float(item.depth[at]) / float(scaled.depth[at])


def compute_factor(item: Observation, known_m: float, measured: MeasuredLength) -> ScaleFactor | None:
    """Compute the factor that makes the measured length the known one; None where a sensor agrees with it."""
    value, sigma = known_m / measured.length_m, measured.sigma
    both = f"known_length is {known_m:.4g} m, in the depth it is {measured.length_m:.4g} m ± {sigma:.1%}"
    if not sigma <= MAX_SIGMA:
        raise InputError(f"{both}: too uncertain; mark a longer length", UNMEASURED)
    if item.scale_source == "sensor":
        tolerance = max(SENSOR_TOLERANCE, SENSOR_SIGMAS * sigma)
        if abs(math.log(value)) > tolerance:
            problem = f"{both}: a sensor's depth is not scaled, and may differ by {tolerance:.0%}"
            raise InputError(f"{problem}; check the length, its pixels and depth_scale", "scale_contradicts_sensor")
        return None
    if not SMALLEST <= value <= LARGEST:
        problem = f"{both}: a factor of {value:.3g}, outside {SMALLEST:g} to {LARGEST:g}"
        raise InputError(f"{problem}; is it in metres, and are the pixels right?", "scale_implausible")
    return ScaleFactor(value, sigma)


def measure_camera_height(view: TableView, known: KnownCameraHeight) -> MeasuredLength:
    """Measure the height of the camera over the table."""
    height = float(view.plane.heights(np.zeros(3)))
    return MeasuredLength(height, math.hypot(view.observation.bend, CAMERA_STD_M / known.length_m))


def measure_object_height(view: TableView, known: KnownHeight, mask: Mask) -> MeasuredLength:
    """Measure the height of an object over the table around it, which a depth model may have bent."""
    item, heights = view.observation, view.heights
    side = max(mask.shape)
    ring = ndimage.binary_dilation(mask, iterations=max(2, round(RING * side))) & view.on_plane & ~mask
    base = float(np.median(heights[ring])) if int(ring.sum()) >= MIN_RING_PIXELS else 0.0
    height = float(np.percentile(heights[mask], TOP_PERCENTILE)) - base
    if height < MIN_OBJECT_HEIGHT_M:
        raise InputError(
            f"known_length: the object rises {height * 1e3:.1f} mm over the table: name another", UNMEASURED
        )
    rows, columns = np.nonzero(mask)
    apart = float(np.hypot(np.ptp(rows), np.ptp(columns))) / side
    away = float(np.median(view.depth[mask]))
    along = abs(float(view.plane.normal[2])) * away * math.sqrt(2.0) * apart * item.bend
    across = math.sqrt(2.0) * get_pixel_std(item.depth.shape) * away / item.camera.fy
    return MeasuredLength(height, math.hypot(item.bend, along / height, across / height, LENGTH_STD_M / known.length_m))


def _find_object(known: KnownHeight, candidates: tuple[Candidate, ...], ids: IdImage, valid: Mask) -> Mask:
    """Find the pixels of the object that a known height is of."""
    if known.pixels:
        (x, y), (height, width) = known.pixels[0], ids.shape
        instance = int(ids[min(max(round(y), 0), height - 1), min(max(round(x), 0), width - 1)])
        problem = f"no object is found at the pixel ({x:g}, {y:g}): mark one well within it"
    else:
        named = [c.instance for c in candidates if c.label.casefold() == known.label.casefold()]
        instance = named[0] if len(named) == 1 else 0
        labels = ", ".join(sorted({c.label for c in candidates})) or "none"
        called = sanitize_line(repr(known.label), 80)
        problem = f"{len(named)} objects are called {called} (labels: {labels[:200]}): mark the one by a pixel"
    mask = (ids == instance) & valid
    if instance <= 0 or not mask.any():
        raise InputError(f"known_length: {problem}", UNMEASURED)
    return mask


def _scale(item: Observation, factor: ScaleFactor | None) -> Observation:
    if factor is None:
        return item
    depth = item.depth * np.float32(factor.value)
    both = math.hypot(item.scale_sigma, factor.sigma)
    deviation = math.log(factor.value) / both if item.scale_sigma > 0.0 else None  # a model may tell no uncertainty
    return replace(item, depth=depth, scale_source="measured", scale_sigma=factor.sigma, scale_deviation=deviation)
