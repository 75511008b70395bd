"""What one picture says about one object: its points in the table frame, and where space was seen to be empty."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from schemas.geometry import Camera, Colors, DepthImage, Frozen, Mask, Points, Pose
from schemas.objects import PerceivedObject, PerceivedObjects
from tableverse_factory.geometry.camera import backproject, project
from tableverse_factory.geometry.transforms import compose, inverse, rotation_matrix, transform_points

Distances = Float64[np.ndarray, " n"]

TABLE_ID = -1
WINDOW_MARGIN_PX = 24
MIN_DEPTH_M = 0.01
THINNED_PX = 2.0
THINNED_STEP_M = 0.006
PAST_SLACK_M = 0.006
OCCLUDER_STEP_M = 0.01
"""A neighbouring object's pixel hides ours where it is at least this much nearer."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting(Frozen):
    """One object in one picture, cropped to a window around it.

    Attributes:
        instance_id: Value of the object's pixels in `PerceivedObjects.instance_ids`.
        points: Denoised points, table frame [m]. Shape (n, 3).
        normals: Unit normals of `points`, towards the camera, table frame. Shape (n, 3).
        colors: sRGB of `points`.
        camera: Intrinsics of the window: pixel (0, 0) is the window's corner.
        camera_to_table: Pose of the camera in the table frame.
        own: Pixels of the object in the window.
        depth: Smoothed depth of the window [m]; 0 where unknown.
        facing: Cosine between the ray and the normal of the surface that ends it, 1 where unknown.
        past: Pixels through which the camera sees past the object; the rest is the object or what hides it.
        outline_px: Distance of each pixel to the border of `past` [px], negative within `past`.
        support_z: Height of what carries the object [m], table frame.
    """

    instance_id: int
    points: Points
    normals: Points
    colors: Colors
    camera: Camera
    camera_to_table: Pose
    own: Mask
    depth: DepthImage
    facing: DepthImage
    past: Mask
    outline_px: DepthImage
    support_z: float

    @property
    def eye(self) -> Float64[np.ndarray, "3"]:
        """Position of the camera in the table frame [m]."""
        return self.camera_to_table.position


def sight(scene: PerceivedObjects, item: PerceivedObject, support_z: float) -> Sighting:
    """Crops the picture around one object and classes its pixels."""
    rows, columns = _window(scene.instance_ids == item.instance_id)
    camera = scene.observation.camera
    window = Camera(
        camera.fx,
        camera.fy,
        camera.cx - columns.start,
        camera.cy - rows.start,
        columns.stop - columns.start,
        rows.stop - rows.start,
    )
    ids = scene.instance_ids[rows, columns]
    raw = np.asarray(scene.observation.depth[rows, columns], dtype=np.float64)
    own = ids == item.instance_id
    trusted = own & _near_points(item.points_camera, window, raw)
    own_depth = _smoothed(raw, trusted)
    past = _seen_past(raw, ids, own, trusted, window, scene.camera_to_table)
    depth = np.where(own, own_depth, np.where(past, _behind(raw, ids, window, scene.camera_to_table), raw))
    cloud = transform_points(scene.camera_to_table, backproject(own_depth, window).reshape(-1, 3))
    cloud = cloud.reshape(*own.shape, 3)
    normals = _normals(cloud, own_depth > 0.0, scene.camera_to_table.position)
    seen = np.isfinite(normals[..., 0])
    to_eye = scene.camera_to_table.position - cloud
    with np.errstate(invalid="ignore"):
        cosine = (normals * to_eye).sum(axis=-1) / np.linalg.norm(to_eye, axis=-1)
    return Sighting(
        instance_id=item.instance_id,
        points=cloud[seen],
        normals=normals[seen],
        colors=np.ascontiguousarray(scene.observation.color[rows, columns][seen]),
        camera=window,
        camera_to_table=scene.camera_to_table,
        own=own,
        depth=depth,
        facing=np.where(seen, np.abs(cosine), 1.0),
        past=past,
        outline_px=_signed_distance(past),
        support_z=support_z,
    )


def emptiness(sighting: Sighting, points: Points, frame: Pose | None = None) -> Distances:
    """How far each point lies from space seen to be empty [m]: negative inside of that space.

    All in front of the end of a ray is empty; behind the end nothing is known, unless the ray passes the object:
    then it is empty as well. Beside the outline the distance to the outline counts, so that the field is continuous
    across it. Rays without depth say nothing. Shape (n,). `frame` is where the points are given, the table frame if
    none is.
    """
    return clearances(sighting, points, frame)[0]


def clearances(
    sighting: Sighting, points: Points, frame: Pose | None = None
) -> tuple[Distances, Distances, Bool[np.ndarray, " n"]]:
    """`emptiness`; how far behind the object's own surface each point lies; whether something else may hide it.

    The second is infinite where the object's surface was not seen [m].
    """
    to_camera = inverse(sighting.camera_to_table)
    u, v, z = _pixels_of(points, to_camera if frame is None else compose(to_camera, frame), sighting.camera)
    inside = z > MIN_DEPTH_M
    height, width = sighting.own.shape
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    outline = ndimage.map_coordinates(sighting.outline_px, [v, u], order=1) * z / sighting.camera.fx
    pixel = np.rint(v).astype(np.intp) * width + np.rint(u).astype(np.intp)
    end = sighting.depth.ravel()[pixel]
    own = sighting.own.ravel()[pixel]
    past = sighting.past.ravel()[pixel]
    # Just behind what a ray ends on beside the object there is no object either: without this slack the noise of
    # the table would grow a skirt around every foot.
    depth_gap = np.where(end > 0.0, z - end - np.where(past, PAST_SLACK_M, 0.0), np.inf)
    beside = np.where(depth_gap < 0.0, np.maximum(-np.abs(outline), depth_gap), np.minimum(np.abs(outline), depth_gap))
    clearance = np.where(past, beside, np.minimum(depth_gap, np.abs(outline)))
    hidden = ~inside | ~(own | past)
    return np.where(inside, clearance, 1.0), np.where(inside & own, depth_gap, np.inf), hidden


def _pixels_of(points: Points, to_camera: Pose, camera: Camera) -> tuple[Distances, Distances, Distances]:
    """Column, row and depth of points, one array each: several times faster than by rows, and this is the hot loop."""
    r, t = rotation_matrix(to_camera.quaternion_wxyz), to_camera.position
    x, y, z = (points[:, k] for k in range(3))
    along = [r[k, 0] * x + r[k, 1] * y + r[k, 2] * z + t[k] for k in range(3)]
    depth = np.maximum(along[2], MIN_DEPTH_M)
    return along[0] / depth * camera.fx + camera.cx, along[1] / depth * camera.fy + camera.cy, along[2]


def _window(own: Mask) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
    height, width = own.shape
    return (
        slice(max(int(rows[0]) - WINDOW_MARGIN_PX, 0), min(int(rows[-1]) + WINDOW_MARGIN_PX + 1, height)),
        slice(max(int(columns[0]) - WINDOW_MARGIN_PX, 0), min(int(columns[-1]) + WINDOW_MARGIN_PX + 1, width)),
    )


def _near_points(points_camera: Points, window: Camera, raw: DepthImage) -> Mask:
    """Pixels whose reading survived the denoising, and their near neighbours, for large clouds come thinned."""
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
    near: Mask = (raw > 0.0) & (away <= THINNED_PX) & beside
    return near


def _smoothed(raw: DepthImage, trusted: Mask) -> DepthImage:
    """Depth averaged over near pixels of near depth (a bilateral filter), within the trusted pixels alone."""
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


def _seen_past(raw: DepthImage, ids: Mask, own: Mask, trusted: Mask, window: Camera, camera_to_table: Pose) -> Mask:
    """Pixels that show what lies behind or beside the object, not what hides it."""
    if not trusted.any():
        return np.zeros(own.shape, dtype=bool)
    nearest = ndimage.distance_transform_edt(~trusted, return_distances=False, return_indices=True)
    own_depth = raw[nearest[0], nearest[1]]
    end = _behind(raw, ids, window, camera_to_table)
    hides = (ids > 0) & (end < own_depth - OCCLUDER_STEP_M)
    past: Mask = ~own & (end > 0.0) & ~hides
    return past


def _behind(raw: DepthImage, ids: Mask, window: Camera, camera_to_table: Pose) -> DepthImage:
    """Where rays end: the reading, or the table's plane for table pixels without one."""
    hole = (ids == TABLE_ID) & (raw <= 0.0)
    if not hole.any():
        return raw
    rays = backproject(np.ones(raw.shape), window) @ rotation_matrix(camera_to_table.quaternion_wxyz).T
    down = rays[..., 2]
    plane = np.where(down < -1e-6, -camera_to_table.position[2] / np.minimum(down, -1e-6), 0.0)
    return np.where(hole, plane, raw)


def _signed_distance(past: Mask) -> DepthImage:
    """Distance to the outline [px]: positive on the object's side, negative where the camera sees past."""
    if not past.any():
        return np.full(past.shape, 1e6)
    inside = ndimage.distance_transform_edt(~past)
    outside = ndimage.distance_transform_edt(past)
    signed: DepthImage = np.where(past, 0.5 - outside, inside - 0.5)
    return signed


def _normals(cloud: Float64[np.ndarray, "h w 3"], known: Mask, eye: Points) -> Float64[np.ndarray, "h w 3"]:
    """Unit normals from neighbouring pixels, towards the camera; NaN where the pixel itself has no depth."""
    points = np.where(known[..., None], cloud, np.nan)
    with np.errstate(invalid="ignore"):
        du, dv = _slope(points, axis=1), _slope(points, axis=0)
        cross = np.cross(du, dv)
        length = np.linalg.norm(cross, axis=-1, keepdims=True)
        normal = cross / np.where(length > 1e-12, length, np.nan)
        to_eye = eye - points
        facing = np.sign((normal * to_eye).sum(axis=-1, keepdims=True))
        fallback = to_eye / np.linalg.norm(to_eye, axis=-1, keepdims=True)
    return np.where(known[..., None], np.where(np.isfinite(normal), normal * facing, fallback), np.nan)


def _slope(points: Float64[np.ndarray, "h w 3"], axis: int) -> Float64[np.ndarray, "h w 3"]:
    """Central difference over two pixels to each side, one-sided where only one side is known."""
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
    slope: Float64[np.ndarray, "h w 3"] = np.where(
        np.isfinite(both), both, np.where(np.isfinite(forward), forward, backward)
    )
    return slope
