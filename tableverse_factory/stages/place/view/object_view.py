"""Evidence of one picture about one object: its points in the table frame, and free space."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage
from skimage.color import rgb2lab

from schemas.geometry import Camera, Colors, DepthImage, Frozen, Mask, Picture, Points, Pose
from schemas.objects import PerceivedObject, PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, rotation_matrix, transform_points
from tableverse_factory.stages.place.view.flying_pixels import (
    find_background_colors,
    find_depth_ramps,
    find_flying_pixels,
)
from tableverse_factory.stages.place.view.object_pixels import (
    RARITY,
    compute_color_share,
    compute_outline_distance,
    compute_pixel_normals,
    drop_outline,
    filter_depth,
    find_background_bleed,
    find_bounds,
    find_denoised_pixels,
    find_free_pixels,
    smooth_depth,
)
from tableverse_factory.stages.place.view.support_from_depth import DepthSupport

Distances = Float64[np.ndarray, " n"]

WINDOW_MARGIN_PX = 24
MIN_DEPTH_M = 0.01
PAST_SLACK_M = 0.006
LEAST_OWN = 0.05  # of the object's colours, from which a pixel's is one of them
TOP_QUANTILE = 0.98  # of heights: flying pixels lie higher than an object's seen top
BAND_M, UPRIGHT_SINE = 0.01, 0.5  # height of the band of upright sides that goes on under what hides the rest


@dataclass(frozen=True, slots=True, eq=False)
class ObjectView(Frozen):
    """One object in one picture, cropped to a window around it.

    Attributes:
        instance_id: Value of the object's pixels in `PerceivedObjects.instance_ids`.
        points: Denoised points, table frame [m]. Shape (n, 3).
        normals: Unit normals of `points`, towards the camera, table frame. Shape (n, 3).
        camera: Intrinsics of the window: pixel (0, 0) is the window's corner.
        window: Rows and columns of the picture that the window shows.
        own: Pixels of the object, without those whose reading was smeared over its outline.
        unread: Pixels that show the object where a sensor reads nothing, or the support behind it.
        background_colors: Pixels of `own` with the colours of what lies beside the object, as the gap of a handle has.
        depth: Smoothed depth [m]; 0 where unknown.
        facing: Cosine between the ray and the normal of the surface that ends it, 1 where unknown.
        past: Pixels through which the camera sees past the object; the rest is the object or an occluder.
        outline_px: Distance of each pixel to the silhouette, the border of `past` [px]; negative within `past`.
        estimated: Whether a model estimated the depth.
    """

    instance_id: int
    points: Points
    normals: Points
    colors: Colors
    camera: Camera
    camera_to_table: Pose
    window: tuple[slice, slice]
    own: Mask
    unread: Mask
    background_colors: Mask
    depth: DepthImage
    facing: DepthImage
    past: Mask
    outline_px: DepthImage
    support: DepthSupport
    estimated: bool = False

    @property
    def support_z(self) -> float:
        """Height of the object's support [m], table frame."""
        return self.support.height

    @property
    def eye(self) -> Float64[np.ndarray, "3"]:
        """Position of the camera in the table frame [m]."""
        return self.camera_to_table.position


def view_object(scene: PerceivedObjects, item: PerceivedObject, support: DepthSupport) -> ObjectView:
    """Crop the picture around one object and classify its pixels."""
    rows, columns = _find_window(scene.instance_ids == item.instance_id)
    whole, pose = scene.observation.camera, scene.camera_to_table
    size = columns.stop - columns.start, rows.stop - rows.start
    window = Camera(whole.fx, whole.fy, whole.cx - columns.start, whole.cy - rows.start, *size)
    ids = scene.instance_ids[rows, columns]
    raw = np.asarray(scene.observation.depth[rows, columns], dtype=np.float64)
    color = scene.observation.color[rows, columns]
    own = ids == item.instance_id
    background_colors = find_background_colors(color, own, ids <= 0)
    estimated = scene.observation.bend > 0.0
    false = find_flying_pixels(background_colors, color, raw, own, ids <= 0, measured=not estimated)
    own, raw, ids = own & ~false, np.where(false, 0.0, raw), np.where(false, 0, ids)
    trusted = own & find_denoised_pixels(item.points_camera, window, raw)
    bleed = _find_bleed(trusted, raw, window, pose, support.height)
    own, trusted = own & ~bleed, trusted & ~bleed
    unread = (own & (raw <= 0.0)) | _find_own_colors(color, bleed, trusted, ids <= 0)
    trusted &= ~find_depth_ramps(raw, own, trusted, window)
    if estimated:
        trusted = drop_outline(own, trusted)
    own_depth = smooth_depth(raw, trusted) if estimated else filter_depth(raw, trusted)
    past, end = find_free_pixels(raw, color, ids, own, trusted, window, pose)
    cloud = transform_points(pose, backproject(own_depth, window).reshape(-1, 3)).reshape(*own.shape, 3)
    normals = compute_pixel_normals(cloud, own_depth > 0.0, pose.position)
    seen = np.isfinite(normals[..., 0])
    to_eye = pose.position - cloud
    with np.errstate(invalid="ignore"):
        cosine = (normals * to_eye).sum(axis=-1) / np.linalg.norm(to_eye, axis=-1)
    points, source = _extend_to_ceiling(cloud[seen], normals[seen], support.ceiling)
    return ObjectView(
        instance_id=item.instance_id,
        points=points,
        normals=normals[seen][source],
        colors=np.ascontiguousarray(color[seen][source]),
        camera=window,
        camera_to_table=pose,
        window=(rows, columns),
        own=own,
        unread=unread & (not estimated),
        background_colors=background_colors & own,
        depth=np.where(own, own_depth, np.where(past, end, raw)),
        facing=np.where(seen, np.abs(cosine), 1.0),
        past=past,
        outline_px=compute_outline_distance(past),
        support=support,
        estimated=estimated,
    )


def _extend_to_ceiling(points: Points, normals: Points, ceiling: float) -> tuple[Points, Int64[np.ndarray, " n"]]:
    """Continue the upright sides under what hides them, up to the ceiling; the second is which point each copies."""
    top = float(np.quantile(points[:, 2], TOP_QUANTILE)) if len(points) else np.inf
    gap = ceiling - top
    upright = np.abs(normals[:, 2]) < UPRIGHT_SINE
    band = np.flatnonzero(upright & (points[:, 2] > top - BAND_M) & (points[:, 2] <= top))
    rises = np.linspace(gap, 0.0, int(np.ceil(gap / BAND_M)) if gap > BAND_M else 0, endpoint=False)
    source = np.concatenate([np.arange(len(points)), np.tile(band, len(rises))])
    extended = points[source]
    extended[len(points) :, 2] += np.repeat(rises, len(band))
    return extended, source


def measure_free_space(view: ObjectView, points: Points, frame: Pose | None = None) -> Distances:
    """Measure the distance of points in a frame, else in the table frame, from free space [m], negative inside it.

    All in front of the end of a ray is empty; behind the end nothing is known, unless the ray passes the object:
    then it is empty as well. Near the silhouette the distance to it counts, so that the field is continuous across it.
    Rays without depth tell nothing.
    """
    return measure_clearances(view, points, frame)[0]


def measure_clearances(
    view: ObjectView, points: Points, frame: Pose | None = None
) -> tuple[Distances, Distances, Bool[np.ndarray, " n"]]:
    """Measure free space, the depth of points behind the object's surface, and whether another object may hide them.

    The second is infinite where the object's surface was not seen [m].
    """
    to_camera = invert_pose(view.camera_to_table)
    u, v, z = _project_columns(points, to_camera if frame is None else compose_poses(to_camera, frame), view.camera)
    inside = z > MIN_DEPTH_M
    height, width = view.own.shape
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    outline = ndimage.map_coordinates(view.outline_px, [v, u], order=1) * z / view.camera.fx
    pixel = np.rint(v).astype(np.intp) * width + np.rint(u).astype(np.intp)
    end, own, past = (values.ravel()[pixel] for values in (view.depth, view.own, view.past))
    # Just behind what a ray ends on beside the object there is no object either: without this slack the noise of
    # the table would grow a skirt around every foot.
    depth_gap = np.where(end > 0.0, z - end - np.where(past, PAST_SLACK_M, 0.0), np.inf)
    beside = np.where(depth_gap < 0.0, np.maximum(-np.abs(outline), depth_gap), np.minimum(np.abs(outline), depth_gap))
    clearance = np.where(past, beside, np.minimum(depth_gap, np.abs(outline)))
    hidden = ~inside | ~(own | past)
    return np.where(inside, clearance, 1.0), np.where(inside & own, depth_gap, np.inf), hidden


def sample_nearest(
    view: ObjectView, points: Points, frame: Pose, images: tuple[DepthImage, ...]
) -> tuple[Distances, list[Distances]]:
    """Compute the depth of points in a frame [m], and the values of images of the window at the pixels next to them."""
    u, v, z = _project_columns(points, compose_poses(invert_pose(view.camera_to_table), frame), view.camera)
    height, width = view.own.shape
    row, column = np.clip(np.rint(v), 0, height - 1).astype(np.intp), np.clip(np.rint(u), 0, width - 1).astype(np.intp)
    return z, [image[row, column] for image in images]


def _find_bleed(trusted: Mask, raw: DepthImage, window: Camera, camera_to_table: Pose, support_z: float) -> Mask:
    """Find the trusted pixels whose readings are of the support beside the object."""
    points = transform_points(camera_to_table, backproject(raw, window)[trusted])
    bleed = np.zeros_like(trusted)
    bleed[trusted] = find_background_bleed(points, support_z)
    return bleed


def _find_own_colors(color: Picture, pixels: Mask, own: Mask, beside: Mask) -> Mask:
    """Find those of some pixels with colours of the object, of which what lies beside it has few."""
    found = np.zeros_like(pixels)
    if pixels.any() and own.any() and beside.any():
        shown = rgb2lab(color)
        on, off = (compute_color_share(shown[pixels], shown[of]) for of in (own, beside))
        found[pixels] = (on > LEAST_OWN) & (on > RARITY * off)
    return found


def _project_columns(points: Points, to_camera: Pose, camera: Camera) -> tuple[Distances, Distances, Distances]:
    """Project points to column, row and depth, one array each: several times faster than by rows in this hot loop."""
    r, t = rotation_matrix(to_camera.quaternion_wxyz), to_camera.position
    x, y, z = (points[:, k] for k in range(3))
    along = [r[k, 0] * x + r[k, 1] * y + r[k, 2] * z + t[k] for k in range(3)]
    depth = np.maximum(along[2], MIN_DEPTH_M)
    return along[0] / depth * camera.fx + camera.cx, along[1] / depth * camera.fy + camera.cy, along[2]


def _find_window(own: Mask) -> tuple[slice, slice]:
    if not own.any():
        raise GeometryError("no pixel of the picture belongs to the object")
    height, width = own.shape
    rows, columns = find_bounds(own)
    return (
        slice(max(rows.start - WINDOW_MARGIN_PX, 0), min(rows.stop + WINDOW_MARGIN_PX, height)),
        slice(max(columns.start - WINDOW_MARGIN_PX, 0), min(columns.stop + WINDOW_MARGIN_PX, width)),
    )
