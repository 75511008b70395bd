"""Pixels around one object: its own, those that see past it, their depth, normals and colours."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
from skimage.color import rgb2lab

from schemas.geometry import TABLE_ID, Camera, DepthImage, IdImage, Mask, Picture, Points, Pose
from tableverse_factory.geometry.math.camera import backproject, project
from tableverse_factory.geometry.math.transforms import rotation_matrix

Planes = Float64[np.ndarray, "3 h w"]

THINNED_PX = 2.0
THINNED_STEP_M = 0.006
LOST_HEIGHT_M = 0.01
FAR_M = 10.0  # end of a ray that passes the object and meets no table [m]
LOST_STEP_M = 0.03
OCCLUDER_STEP_M = 0.01  # least step by which a neighbouring object's pixel is nearer and occludes this one [m]
SPILL_HEIGHT_M = 0.01
SPILL_AWAY_M = 0.006
TALL_M = 0.04  # least height of an object beside which pixels at its support's height are mask bleed, no flat part [m]
SAMPLES, BLOCK = 400, 256
NEAR = 12.0  # distance in CIELAB within which colours are alike
RARITY = 4.0  # ratio of frequencies from which a colour is the background's; so is one that the object lacks
INSET_PX = 2
OUTLINE_PX = 4  # breadth of the band along an outline where estimated depth is no surface's [px]
SMOOTH_SHARE = 0.04  # of the root of an object's area: standard deviation of the filter of its estimated depth


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


def find_bounds(mask: Mask) -> tuple[slice, slice]:
    """Find the rows and columns that hold all of a mask, which is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def filter_depth(raw: DepthImage, trusted: Mask) -> DepthImage:
    """Average depth over near pixels of near depth (a bilateral filter), within the trusted pixels alone."""
    result = np.zeros(raw.shape)
    if trusted.any():
        box = find_bounds(trusted)
        result[box] = _filter_depth(raw[box], trusted[box])
    return result


def _filter_depth(raw: DepthImage, trusted: Mask) -> DepthImage:
    middle = float(np.median(raw[trusted]))
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


def drop_outline(own: Mask, trusted: Mask) -> Mask:
    """Drop the pixels of an object next to its outline, where a model's depth runs over to what lies beside it.

    Of narrow parts the middle stays.
    """
    inset = ndimage.distance_transform_edt(np.pad(own, 1))[1:-1, 1:-1]
    widest = ndimage.maximum_filter(inset, size=2 * OUTLINE_PX + 1)
    return trusted & (inset > np.minimum(OUTLINE_PX, 0.5 * widest))


def smooth_depth(raw: DepthImage, trusted: Mask) -> DepthImage:
    """Smooth estimated depth within the trusted pixels, over a share of the object's breadth: ripples are no shape."""
    if not trusted.any():
        return np.zeros(raw.shape)
    width = SMOOTH_SHARE * float(np.sqrt(trusted.sum()))
    weight = ndimage.gaussian_filter(trusted.astype(np.float64), width)
    total = ndimage.gaussian_filter(np.where(trusted, raw, 0.0), width)
    return np.where(trusted, total / np.maximum(weight, 1e-9), 0.0)


def find_free_pixels(
    raw: DepthImage, color: Picture, ids: IdImage, own: Mask, trusted: Mask, window: Camera, camera_to_table: Pose
) -> tuple[Mask, DepthImage]:
    """Find the pixels that see past the object, not those of an occluder; and the ends of the rays [m]."""
    if not trusted.any():
        return np.zeros(own.shape, dtype=bool), raw
    nearest = ndimage.distance_transform_edt(~trusted, return_distances=False, return_indices=True)
    own_depth = raw[nearest[0], nearest[1]]
    plane = _intersect_table(window, camera_to_table)
    end = np.where((ids == TABLE_ID) & (raw <= 0.0) & np.isfinite(plane), plane, raw)
    hides = (ids > 0) & (end < own_depth - OCCLUDER_STEP_M)
    # An unlabelled pixel above the table, about as far as the nearest own one: the mask may have lost it.
    up = rotation_matrix(camera_to_table.quaternion_wxyz)[2]
    height = backproject(end, window) @ up + camera_to_table.position[2]
    lost = (ids <= 0) & (height > LOST_HEIGHT_M) & (np.abs(end - own_depth) < LOST_STEP_M)
    past: Mask = ~own & (end > 0.0) & ~hides & ~lost
    doubtful = ~own & (lost | ((end <= 0.0) & (ids <= 0)))
    foreign = find_foreign_colors(color, own, past, doubtful)
    return past | foreign, np.where(foreign, np.minimum(plane, FAR_M), end)


def _intersect_table(window: Camera, camera_to_table: Pose) -> DepthImage:
    """Compute the depth at which each ray meets the table's plane [m], infinite where it does not."""
    rays = backproject(np.ones((window.height, window.width)), window)
    down = rays @ rotation_matrix(camera_to_table.quaternion_wxyz)[2]
    return np.where(down < -1e-6, -camera_to_table.position[2] / np.minimum(down, -1e-6), np.inf)


def find_foreign_colors(color: Picture, own: Mask, past: Mask, asked: Mask) -> Mask:
    """Find the `asked` pixels whose colour the object lacks, or is far more frequent in the background.

    Sensors lose black and shiny surfaces and steep steps, on the object and beside it; the colour still tells.
    """
    answer = np.zeros(own.shape, dtype=bool)
    core = ndimage.binary_erosion(own, iterations=INSET_PX)
    if not asked.any() or not core.any():
        return answer
    shown = rgb2lab(color)
    on, off = compute_color_share(shown[asked], shown[core]), compute_color_share(shown[asked], shown[past])
    answer[asked] = (on == 0.0) | (RARITY * on < off)
    return answer


def compute_color_share(
    colors: Float64[np.ndarray, "n 3"], known: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, " n"]:
    """Compute the share of the known colours that are like each of `colors`."""
    sample = known[:: max(1, -(-len(known) // SAMPLES))]
    if len(sample) == 0:
        return np.zeros(len(colors))
    # Squared distances by matrix products, a block in the cache at a time: a third of the time of a tree.
    asked = np.stack([*colors.T, (colors**2).sum(axis=1), np.ones(len(colors))])
    against = np.column_stack([-2.0 * sample, np.ones(len(sample)), (sample**2).sum(axis=1)])
    blocks = (asked[:, start : start + BLOCK] for start in range(0, len(colors), BLOCK))
    counts = [(against @ block <= NEAR**2).sum(axis=0, dtype=np.uint16) for block in blocks]
    return np.concatenate([np.zeros(0), *counts]) / len(sample)


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
    result = np.full(cloud.shape, np.nan)
    if known.any():
        box = find_bounds(known)
        result[box] = _compute_normals(cloud[box], known[box], eye)
    return result


def _compute_normals(cloud: Float64[np.ndarray, "h w 3"], known: Mask, eye: Points) -> Float64[np.ndarray, "h w 3"]:
    points = np.where(known, np.moveaxis(cloud, -1, 0), np.nan)  # a plane per axis: numpy is slow on rows of three
    with np.errstate(invalid="ignore"):
        (ax, ay, az), (bx, by, bz) = _compute_slope(points, axis=2), _compute_slope(points, axis=1)
        cross = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
        length = _measure_length(cross)
        normal = cross / np.where(length > 1e-12, length, np.nan)
        to_eye = eye[:, None, None] - points
        facing = np.sign((normal * to_eye).sum(axis=0))
        fallback = to_eye / _measure_length(to_eye)
    return np.moveaxis(np.where(np.isfinite(normal), normal * facing, fallback), 0, -1)


def _compute_slope(points: Planes, axis: int) -> Planes:
    """Compute central differences over two pixels to each side, one-sided where only one side is known."""
    padded = np.pad(points, [(2, 2) if k == axis else (0, 0) for k in range(3)], constant_values=np.nan)
    before, after = (padded[:, :, :-4], padded[:, :, 4:]) if axis == 2 else (padded[:, :-4], padded[:, 4:])
    forward, backward = after - points, points - before
    ahead, back = _measure_length(forward), _measure_length(backward)
    both = np.where(ahead > 3 * back, backward, np.where(back > 3 * ahead, forward, (forward + backward) / 2))
    return np.where(np.isfinite(both), both, np.where(np.isfinite(forward), forward, backward))


def _measure_length(vectors: Planes) -> DepthImage:
    return np.sqrt((vectors * vectors).sum(axis=0))


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
