"""The visible surface: normals, and borders between objects.

Two objects meet where the surface steps back or at a concave crease. A convex crease is the edge of one object, and is
no border (Stein et al. 2014, "Object partitioning using local convexity").
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from schemas.geometry import Camera, DepthImage, Frozen
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.stages.perceive.base.table_view import compute_depth_noise

NORMAL_RADIUS_M = 0.007  # of the disc to which a normal is fitted, at the depth of the objects
MIN_RADIUS_PX, MAX_RADIUS_PX = 2, 8  # bounds of it in the picture
# Difference in depth up to which a reading is of the same surface, in [m] and in deviations of the noise: to fit a
# normal the larger of the first two, and half the disc's radius more; to average the last
SAME_SURFACE_M, SAME_SURFACE_NOISES, SMOOTHED_NOISES = 0.008, 3, 4
MIN_READINGS = 5  # that support a normal
MIN_SPREAD = 0.05  # least determinant of their covariance [px⁴], at a spacing of 1 px: readings in a line have less
# Border of strength 1: how much normals lean towards each other (1.41 at a right-angled crease), and a step in
# deviations of the noise, but never a smaller one than `MIN_STEP_M`
CONCAVITY_OF_BORDER = 0.7
STEP_OF_BORDER, MIN_STEP_M = 4.0, 0.006
STRONGEST = 2.0  # a border that is stronger counts as so strong
BLUR_PX = 0.7  # standard deviation by which borders are blurred
# Distance of two points from which a step is between them and no crease is measured, in units of the radius at which
# normals are compared. The radius is in pixels, which count as wide as with this focal length, whatever the camera's
MAX_ACROSS, FOCAL_PX = 6, 500

Pixels = tuple[np.ndarray, np.ndarray]  # rows and columns
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows and columns to half of the eight neighbours: pairs count once


@dataclass(frozen=True, slots=True, eq=False)
class Surface(Frozen):
    """The smoothed surface of a depth image."""

    points: Float64[np.ndarray, "h w 3"]  # camera frame [m]
    normals: Float64[np.ndarray, "h w 3"]  # unit vectors towards the camera, zero where there are too few readings
    borders: Float64[np.ndarray, "h w"]  # strength of the border between objects: 0 for none, 1 or more for certain


def compute_surface(depth: DepthImage, camera: Camera, typical_depth_m: float) -> Surface:
    """Compute the surface of a depth image, its scale set for objects at `typical_depth_m` from the camera."""
    pitch = typical_depth_m / camera.fx
    radius = int(np.clip(round(NORMAL_RADIUS_M / pitch), MIN_RADIUS_PX, MAX_RADIUS_PX))
    noise = compute_depth_noise(depth)
    smooth = _smooth_depth(np.asarray(depth, dtype=np.float64), noise)
    points = backproject(smooth, camera)
    reach = np.maximum(SAME_SURFACE_M, SAME_SURFACE_NOISES * noise) + 0.5 * radius * pitch
    normals = fit_normals(smooth, camera, radius, reach)
    bend = np.maximum(*(_measure_concavity(points, normals, r) for r in (max(1, round(0.6 * radius)), radius)))
    step = _measure_steps(points, normals) / np.maximum(MIN_STEP_M, STEP_OF_BORDER * noise)
    borders = np.minimum(np.maximum(bend / CONCAVITY_OF_BORDER, step), STRONGEST)
    return Surface(points, normals, ndimage.gaussian_filter(borders, BLUR_PX))


def measure_border(surface: Surface, first: Pixels, second: Pixels) -> Float64[np.ndarray, " n"]:
    """Measure the border between pairs of pixels, as `Surface.borders`; 0 where a normal is unknown."""
    p, q, n, m = surface.points[first], surface.points[second], surface.normals[first], surface.normals[second]
    across = q - p
    step = np.minimum(np.abs(np.einsum("ij,ij->i", across, n)), np.abs(np.einsum("ij,ij->i", across, m)))
    lean = np.einsum("ij,ij->i", n - m, across) / np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    limit = np.maximum(MIN_STEP_M, STEP_OF_BORDER * compute_depth_noise(np.minimum(p[:, 2], q[:, 2])))
    known = (n[:, 2] < 0) & (m[:, 2] < 0)
    strength = np.clip(np.maximum(step / limit, lean / CONCAVITY_OF_BORDER), 0.0, STRONGEST)
    return np.where(known, strength, 0.0)


def shift_image(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Shift an image: `result[y, x] = image[y + rows, x + columns]`, zero outside."""
    result = np.zeros_like(image)
    height, width = image.shape[:2]
    if abs(rows) >= height or abs(columns) >= width:
        return result
    result[max(-rows, 0) : height - max(rows, 0), max(-columns, 0) : width - max(columns, 0)] = image[
        max(rows, 0) : height - max(-rows, 0), max(columns, 0) : width - max(-columns, 0)
    ]
    return result


def _smooth_depth(depth: Float64[np.ndarray, "h w"], noise: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Average twice over 3 x 3 pixels, without those on another surface."""
    for _ in range(2):
        total, count = np.zeros_like(depth), np.zeros_like(depth)
        for rows, columns in product((-1, 0, 1), repeat=2):
            other = shift_image(depth, rows, columns)
            near = (other > 0) & (np.abs(other - depth) < SMOOTHED_NOISES * noise)
            total += np.where(near, other, 0.0)
            count += near
        depth = np.where(depth > 0, total / np.maximum(count, 1), 0.0)
    return depth


def fit_normals(
    depth: Float64[np.ndarray, "h w"], camera: Camera, radius: int, reach: Float64[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w 3"]:
    """Fit normals by regression over a disc of pixels: a plane's inverse depth is linear in the pixel coordinates.

    Readings further in depth than `reach` [m] belong to another surface; `radius` is in pixels. Returns unit vectors
    towards the camera, zero where fewer than `MIN_READINGS` support one.
    """
    valid = depth > 0
    near_depth, limit = depth.astype(np.float32), reach.astype(np.float32)
    inverse = np.where(valid, 1.0 / np.maximum(depth, 1e-3), 0.0).astype(np.float32)
    count, u, v, d, uu, uv, vv, ud, vd = np.zeros((9, *depth.shape), dtype=np.float32)
    step = max(1, -(-radius // 4))
    span = range(-(radius // step) * step, radius + 1, step)
    for rows, columns in ((r, c) for r, c in product(span, repeat=2) if r * r + c * c <= radius * radius + 1):
        other = shift_image(near_depth, rows, columns)
        near = ((other > 0) & (np.abs(other - near_depth) < limit)).astype(np.float32)
        rise = (shift_image(inverse, rows, columns) - inverse) * near
        count += near
        u += columns * near
        v += rows * near
        uu += columns * columns * near
        uv += columns * rows * near
        vv += rows * rows * near
        d += rise
        ud += columns * rise
        vd += rows * rise
    n = np.maximum(count, 1.0)
    u, v, d = u / n, v / n, d / n
    uu, uv, vv, ud, vd = uu / n - u * u, uv / n - u * v, vv / n - v * v, ud / n - u * d, vd / n - v * d
    determinant = uu * vv - uv * uv
    usable = valid & (count >= MIN_READINGS) & (determinant > MIN_SPREAD * step**4)
    determinant = np.where(usable, determinant, 1.0)
    a, b = (ud * vv - vd * uv) / determinant, (vd * uu - ud * uv) / determinant
    pixel_v, pixel_u = np.indices(depth.shape, dtype=np.float64)
    at_origin = (inverse + d) - a * (pixel_u + u) - b * (pixel_v + v)
    normals = -np.stack([a * camera.fx, b * camera.fy, a * camera.cx + b * camera.cy + at_origin], axis=-1)
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(usable[..., None], normals / np.maximum(lengths, 1e-9), 0.0).astype(np.float64)


def _measure_concavity(
    points: Float64[np.ndarray, "h w 3"], normals: Float64[np.ndarray, "h w 3"], radius: int
) -> Float64[np.ndarray, "h w"]:
    """Measure how much the normals lean towards each other across a pixel, the most of four directions; 0 if convex.

    For a right-angled concave crease it is the square root of 2; beyond a step nothing is compared.
    """
    known = normals[..., 2] < 0
    most = np.zeros(known.shape)
    for direction in DIRECTIONS:
        reach = radius if 0 in direction else round(0.7 * radius)
        rows, columns = reach * direction[0], reach * direction[1]
        across = shift_image(points, rows, columns) - shift_image(points, -rows, -columns)
        turn = shift_image(normals, -rows, -columns) - shift_image(normals, rows, columns)
        length = np.linalg.norm(across, axis=-1)
        lean = np.einsum("ijk,ijk->ij", turn, across) / np.maximum(length, 1e-9)
        near = length < MAX_ACROSS * radius * points[..., 2] / FOCAL_PX
        fits = known & near & shift_image(known, rows, columns) & shift_image(known, -rows, -columns)
        most = np.maximum(most, np.where(fits, lean, 0.0))
    return most


def _measure_steps(
    points: Float64[np.ndarray, "h w 3"], normals: Float64[np.ndarray, "h w 3"]
) -> Float64[np.ndarray, "h w"]:
    """Measure the jump at a pixel [m]: the distance of the points on either side from each other's tangent plane."""
    known = normals[..., 2] < 0
    most = np.zeros(known.shape)
    for rows, columns in DIRECTIONS:
        across = shift_image(points, rows, columns) - shift_image(points, -rows, -columns)
        both = known & shift_image(known, rows, columns) & shift_image(known, -rows, -columns)
        ahead = np.abs(np.einsum("ijk,ijk->ij", across, shift_image(normals, rows, columns)))
        behind = np.abs(np.einsum("ijk,ijk->ij", across, shift_image(normals, -rows, -columns)))
        most = np.maximum(most, np.where(both, np.minimum(ahead, behind), 0.0))
    return most
