"""Pixels around one object: its own, those that see past it, their depth and normals."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Camera, DepthImage, IdImage, Mask, Picture, Points, Pose
from tableverse_factory.geometry.math.camera import backproject, project
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.stages.place.view.color_model import find_foreign_colors

TABLE_ID = -1
THINNED_PX = 2.0
THINNED_STEP_M = 0.006
LOST_HEIGHT_M = 0.01
FAR_M = 10.0
"""End of a ray that passes the object and meets no table [m]."""
LOST_STEP_M = 0.03
OCCLUDER_STEP_M = 0.01
"""Least step by which a neighbouring object's pixel is nearer and occludes this one [m]."""
SPILL_HEIGHT_M = 0.01
SPILL_AWAY_M = 0.006
TALL_M = 0.04
"""Least height of an object beside which pixels at its support's height are mask bleed, not a flat part [m]."""


def find_denoised_pixels(points_camera: Points, window: Camera, raw: DepthImage) -> Mask:
    """Find the pixels with a denoised reading, and their near neighbours, because large clouds come thinned."""
    pixels = project(points_camera, window)
    column, row = np.rint(pixels[:, 0]).astype(int), np.rint(pixels[:, 1]).astype(int)
    height, width = raw.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    hit = np.zeros(raw.shape, dtype=bool)
    hit[row[inside], column[inside]] = True
    hit &= raw > 0.0
    if not hit.any():
        return hit
    away, nearest = ndimage.distance_transform_edt(~hit, return_indices=True)
    beside = np.abs(raw - raw[nearest[0], nearest[1]]) < THINNED_STEP_M
    return (raw > 0.0) & (away <= THINNED_PX) & beside


def filter_depth(raw: DepthImage, trusted: Mask) -> DepthImage:
    """Average depth over near pixels of near depth (a bilateral filter), within the trusted pixels alone."""
    middle = float(np.median(raw[trusted])) if trusted.any() else 1.0
    tolerance = 0.004 + 0.004 * middle * middle
    total = np.zeros(raw.shape)
    weight = np.zeros(raw.shape)
    padded = np.pad(np.where(trusted, raw, np.inf), 2, constant_values=np.inf)
    height, width = raw.shape
    for dv in range(5):
        for du in range(5):
            other = padded[dv : dv + height, du : du + width]
            gap = np.where(trusted & np.isfinite(other), other - raw, np.inf)
            w = np.where(np.abs(gap) < tolerance, np.exp(-((dv - 2) ** 2 + (du - 2) ** 2) / 4.0), 0.0)
            total += w * np.where(w > 0.0, other, 0.0)
            weight += w
    return np.where(trusted, total / np.maximum(weight, 1e-12), 0.0)


def find_free_pixels(
    raw: DepthImage, color: Picture, ids: IdImage, own: Mask, trusted: Mask, window: Camera, camera_to_table: Pose
) -> tuple[Mask, DepthImage]:
    """Find the pixels that see past the object, not those of an occluder; and the ends of the rays [m]."""
    if not trusted.any():
        return np.zeros(own.shape, dtype=bool), raw
    nearest = ndimage.distance_transform_edt(~trusted, return_distances=False, return_indices=True)
    own_depth = raw[nearest[0], nearest[1]]
    end = _compute_ray_ends(raw, ids, window, camera_to_table)
    hides = (ids > 0) & (end < own_depth - OCCLUDER_STEP_M)
    # An unlabelled pixel above the table, about as far as the nearest own one: the mask may have lost it.
    up = rotation_matrix(camera_to_table.quaternion_wxyz)[2]
    height = backproject(end, window) @ up + camera_to_table.position[2]
    lost = (ids <= 0) & (height > LOST_HEIGHT_M) & (np.abs(end - own_depth) < LOST_STEP_M)
    past: Mask = ~own & (end > 0.0) & ~hides & ~lost
    doubtful = ~own & (lost | ((end <= 0.0) & (ids <= 0)))
    foreign = find_foreign_colors(color, own, past, doubtful)
    return past | foreign, np.where(foreign, np.minimum(_intersect_table(window, camera_to_table), FAR_M), end)


def _compute_ray_ends(raw: DepthImage, ids: IdImage, window: Camera, camera_to_table: Pose) -> DepthImage:
    """Compute the ends of rays: the reading, or the table's plane for table pixels without one."""
    hole = (ids == TABLE_ID) & (raw <= 0.0)
    plane = _intersect_table(window, camera_to_table)
    return np.where(hole & np.isfinite(plane), plane, raw)


def _intersect_table(window: Camera, camera_to_table: Pose) -> DepthImage:
    """Compute the depth at which each ray meets the table's plane [m], infinite where it does not."""
    rays = backproject(np.ones((window.height, window.width)), window)
    down = rays @ rotation_matrix(camera_to_table.quaternion_wxyz)[2]
    return np.where(down < -1e-6, -camera_to_table.position[2] / np.minimum(down, -1e-6), np.inf)


def compute_outline_distance(past: Mask) -> DepthImage:
    """Compute the distance to the silhouette [px], negative where the camera sees past."""
    if not past.any():
        return np.full(past.shape, 1e6)
    inside = ndimage.distance_transform_edt(~past)
    outside = ndimage.distance_transform_edt(past)
    return np.where(past, 0.5 - outside, inside - 0.5)


def compute_pixel_normals(
    cloud: Float64[np.ndarray, "h w 3"], known: Mask, eye: Points
) -> Float64[np.ndarray, "h w 3"]:
    """Compute unit normals from neighbouring pixels, towards the camera; NaN where the pixel has no depth."""
    points = np.where(known[..., None], cloud, np.nan)
    with np.errstate(invalid="ignore"):
        du, dv = _compute_slope(points, axis=1), _compute_slope(points, axis=0)
        cross = np.cross(du, dv)
        length = np.linalg.norm(cross, axis=-1, keepdims=True)
        normal = cross / np.where(length > 1e-12, length, np.nan)
        to_eye = eye - points
        facing = np.sign((normal * to_eye).sum(axis=-1, keepdims=True))
        fallback = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    return np.where(known[..., None], np.where(np.isfinite(normal), normal * facing, fallback), np.nan)


def _compute_slope(points: Float64[np.ndarray, "h w 3"], axis: int) -> Float64[np.ndarray, "h w 3"]:
    """Compute central differences over two pixels to each side, one-sided where only one side is known."""
    step = 2
    ahead = np.full_like(points, np.nan)
    back = np.full_like(points, np.nan)
    front: list[slice] = [slice(None)] * 3
    rear: list[slice] = [slice(None)] * 3
    front[axis], rear[axis] = slice(step, None), slice(None, -step)
    ahead[tuple(rear)] = points[tuple(front)]
    back[tuple(front)] = points[tuple(rear)]
    forward, backward = ahead - points, points - back
    jump = np.linalg.norm(forward, axis=-1, keepdims=True) > 3 * np.linalg.norm(backward, axis=-1, keepdims=True)
    jump_back = np.linalg.norm(backward, axis=-1, keepdims=True) > 3 * np.linalg.norm(forward, axis=-1, keepdims=True)
    both = np.where(jump, backward, np.where(jump_back, forward, (forward + backward) / 2))
    return np.where(np.isfinite(both), both, np.where(np.isfinite(forward), forward, backward))


def find_background_bleed(points: Points, support_z: float) -> Mask:
    """Find the points of the table frame that a mask took from the support beside a tall object. Shape (n,)."""
    height = points[:, 2] - support_z
    low = height < SPILL_HEIGHT_M
    if not low.any() or low.all() or float(np.quantile(height, 0.95)) < TALL_M:
        return np.zeros(len(points), dtype=bool)
    try:
        sides = ConvexHull(points[~low, :2]).equations
    except (QhullError, ValueError):
        return np.zeros(len(points), dtype=bool)
    result = low.copy()
    result[low] = (points[low, :2] @ sides[:, :2].T + sides[:, 2]).max(axis=1) > SPILL_AWAY_M
    return result
