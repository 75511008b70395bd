"""Lengths between pixels, as the depth of an observation has them, and how sure they are."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import least_squares

from schemas.geometry import Camera, Frozen, Points, Vector3
from schemas.known_length import KnownDistance, KnownSheet, Pixel, get_pixel_std
from schemas.observation import Observation
from tableverse_factory.core.errors import InputError

UNMEASURED = "known_length_unmeasured"
LENGTH_STD_M = 0.001  # of a length that was measured by hand
REACH, NEAR = 0.005, 0.002  # radii around a marked pixel, in longer sides: of the fitted surface, of what is meant
ONE_SURFACE = 0.04  # depths that differ by more than this share lie on two surfaces
MIN_READINGS = 6
MAX_MISFIT = 0.1  # relative error of the sides of a sheet, root mean square
MAX_SLANT_DEG = 25.0  # between the plane of the corners of a sheet and that of the depth within
_STEP_PX = 0.25

Pixels = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True, slots=True)
class MeasuredLength:
    """A length in the observation's depth [m], and the standard deviation of its logarithm."""

    length_m: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class InversePlane(Frozen):
    """Plane before the camera: at a ray (x, y, 1), `1 / z = coefficients @ ray` [1/m]."""

    coefficients: Vector3

    def compute_points(self, pixels: Pixels, camera: Camera) -> Points:
        """Compute the plane's points at pixels, camera frame [m]."""
        rays = compute_rays(pixels, camera)
        return rays / (rays @ self.coefficients)[:, None]

    def compute_angle_deg(self, other: "InversePlane") -> float:
        """Compute the angle between two planes."""
        one, two = (plane.coefficients / np.linalg.norm(plane.coefficients) for plane in (self, other))
        return float(np.degrees(np.arccos(np.clip(one @ two, -1.0, 1.0))))


def compute_rays(pixels: Pixels, camera: Camera) -> Points:
    """Compute the lines of sight of pixels, at z = 1."""
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(len(pixels))], axis=1)


def measure_distance(observation: Observation, known: KnownDistance) -> MeasuredLength:
    """Measure the distance between the surfaces at two pixels."""
    camera, bend = observation.camera, observation.bend
    planes = [_fit_surface_at(observation, pixel) for pixel in known.pixels]
    pixels = np.array(known.pixels)

    def span(at: Pixels) -> Points:
        ends = [plane.compute_points(pixel[None], camera)[0] for plane, pixel in zip(planes, at, strict=True)]
        return np.array(ends)

    def measure(at: Pixels) -> float:
        first, second = span(at)
        return float(np.linalg.norm(first - second))

    first, second = span(pixels)
    length = measure(pixels)
    if not 1e-4 < length < 1e3:
        raise InputError(f"known_length: the two pixels show points {length:.2g} m apart: mark others", UNMEASURED)
    along = float((first - second) @ (first + second)) / 2.0 / length**2  # of the line of sight, over the length
    apart = min(1.0, float(np.linalg.norm(pixels[0] - pixels[1])) / max(observation.depth.shape))
    from_pixels = _propagate(lambda at: float(np.log(measure(at))), pixels) * get_pixel_std(observation.depth.shape)
    parts = (from_pixels, bend, along * bend * np.sqrt(2.0) * apart, LENGTH_STD_M / known.length_m)
    return MeasuredLength(length, float(np.linalg.norm(parts)))


def measure_sheet(observation: Observation, known: KnownSheet) -> MeasuredLength:
    """Measure the longer side of a sheet: its plane follows from its corners alone, its depth is read within them.

    The slant of the plane so owes nothing to a depth model, and many readings are compared at once.
    """
    inside = _find_inside(np.array(known.pixels), observation.depth.shape) & (observation.depth > 0)
    rows, columns = np.nonzero(inside)
    if len(rows) < MIN_READINGS:
        raise InputError(f"known_length: {len(rows)} depth readings lie between the corners: too few", UNMEASURED)
    rays = compute_rays(np.stack([columns, rows], axis=1).astype(np.float64), observation.camera)
    depth = observation.depth[inside].astype(np.float64)
    seen = InversePlane(np.linalg.lstsq(rays, 1.0 / depth, rcond=None)[0])

    def compare(plane: InversePlane) -> float:
        return float(np.log(np.median(depth * (rays @ plane.coefficients))))

    def fit(at: Pixels) -> tuple[InversePlane, float]:
        return _fit_sheet(at, observation.camera, known.size_m, seen)

    corners = np.array(known.pixels)
    plane, misfit = fit(corners)
    slant_deg = plane.compute_angle_deg(seen)
    if not (misfit <= MAX_MISFIT and slant_deg <= MAX_SLANT_DEG):
        differs = f"its sides differ by {misfit:.0%}, its plane from the depth's by {slant_deg:.0f}°"
        raise InputError(
            f"known_length: the corners make no {known.kind}: {differs}; mark its four corners", UNMEASURED
        )
    log_ratio = compare(plane)
    from_pixels = _propagate(lambda at: compare(fit(at)[0]), corners) * get_pixel_std(observation.depth.shape)
    return MeasuredLength(known.size_m[0] * float(np.exp(log_ratio)), float(np.hypot(from_pixels, observation.bend)))


def _fit_surface_at(observation: Observation, pixel: Pixel) -> InversePlane:
    """Fit the surface around a pixel; at an edge the nearer of the two is meant."""
    height, width = observation.depth.shape
    side = max(height, width)
    column, row = (min(max(round(at), 0), size - 1) for at, size in zip(pixel, (width, height), strict=True))
    reach, near = max(2, round(REACH * side)), max(1, round(NEAR * side))
    top, left = max(row - reach, 0), max(column - reach, 0)
    window = observation.depth[top : row + reach + 1, left : column + reach + 1].astype(np.float64)
    rows, columns = np.nonzero(window)
    if len(rows) < MIN_READINGS:
        raise InputError(
            f"known_length: within {reach} px of ({pixel[0]:g}, {pixel[1]:g}) are {len(rows)} depth readings, too few: "
            "mark another pixel",
            UNMEASURED,
        )
    depth = window[rows, columns]
    at = np.stack([columns + left, rows + top], axis=1).astype(np.float64)
    distance = np.linalg.norm(at - pixel, axis=1)
    anchor = depth[distance <= max(near, distance.min())].min()
    same = np.abs(depth - anchor) <= ONE_SURFACE * anchor
    if same.sum() < MIN_READINGS:
        return InversePlane(np.array([0.0, 0.0, 1.0 / np.median(depth[same])]))
    weights = np.exp(-0.5 * (distance[same] / near) ** 2)  # at a corner, faces behind it count less
    rays = compute_rays(at[same], observation.camera)
    return InversePlane(np.linalg.lstsq(rays * weights[:, None], weights / depth[same], rcond=None)[0])


def _propagate(compute: Callable[[Pixels], float], pixels: Pixels) -> float:
    """Propagate a deviation of one pixel, alike in all coordinates, to a figure."""
    slopes = []
    for place in np.ndindex(pixels.shape):
        step = np.zeros_like(pixels)
        step[place] = _STEP_PX
        slopes.append((compute(pixels + step) - compute(pixels - step)) / (2.0 * _STEP_PX))
    return float(np.linalg.norm(slopes))


def _find_inside(corners: Pixels, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """Find the pixels within a convex outline."""
    v, u = np.indices(shape[:2], dtype=np.float64)
    after = np.roll(corners, -1, axis=0)
    sides = [(b[0] - a[0]) * (v - a[1]) - (b[1] - a[1]) * (u - a[0]) for a, b in zip(corners, after, strict=True)]
    return np.all([side > 0 for side in sides], axis=0) | np.all([side < 0 for side in sides], axis=0)


def _fit_sheet(
    corners: Pixels, camera: Camera, size_m: tuple[float, float], start: InversePlane
) -> tuple[InversePlane, float]:
    """Fit the plane on which the corners span the sheet, either side first, and the misfit of its sides."""
    first, second = np.triu_indices(4, 1)
    rays = compute_rays(corners, camera)

    def measure_sides(coefficients: Vector3) -> Float64[np.ndarray, "6"]:
        points = rays / (rays @ coefficients)[:, None]
        return np.linalg.norm(points[first] - points[second], axis=1)

    fits = []
    for one, other in (size_m, size_m[::-1]):
        diagonal = float(np.hypot(one, other))
        sides = np.array([one, diagonal, other, other, diagonal, one])  # 01, 02, 03, 12, 13, 23
        scaled = start.coefficients * measure_sides(start.coefficients).mean() / sides.mean()
        found = least_squares(lambda at, sides=sides: measure_sides(at) / sides - 1.0, scaled, method="lm")
        fits.append((float(np.sqrt(np.mean(found.fun**2))), InversePlane(found.x)))
    misfit, plane = min(fits, key=lambda fit: fit[0])
    return plane, misfit
