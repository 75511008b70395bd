"""Free-form completion by inflation: the hidden side mirrors the seen one about a membrane through the silhouette.

Rays that touch a body whose sections are centrally symmetric, as ellipses and boxes are, do so at opposite points: the
body's middle lies on the chord between them. A membrane stretched over the depth of the silhouette continues these
chords to free shapes, and along each ray the body ends as far behind it as it begins before it. Columns below reach the
support where the body so estimated almost does. Elsewhere its underside lies between that of the body and that which
its visible edges tell: the errors of the two are independent.
"""

import numpy as np
from jaxtyping import Bool, Int64
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from schemas.geometry import DepthImage, Mask
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.voxel_solids import Field, extract_surface
from tableverse_factory.stages.place.completion.underside import compute_half_width
from tableverse_factory.stages.place.completion.voxel_carving import (
    CarvedSurface,
    build_flat_grid,
    close_floor,
    compute_column_field,
    drop_crumbs,
    find_footprint,
    place_frame,
)
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space, sample_nearest

MEMBRANE_PIXELS = 4000  # unknowns of the membrane: it is smooth, more tell nothing
STEP_M = 0.01  # least step of depth between neighbouring pixels at which the nearer surface ends [m]
HIDDEN_M = 0.02  # most thickness given to what ends at a step, over its half: it may reach the surface behind [m]
OVERLAP_M = 0.002
SETTLED_M = 0.003  # height above the support up to which an outline is a line of contact and no silhouette [m]
INWARD_PX = 3
MAX_SLOPE = 3.0
MAX_LOST = 0.6  # most share of half a thickness that lies between the last reading and the outline
THICKNESS_RANGE_M = (0.002, 0.2)
MARGIN_PX = 2.0
FILLED_SHARE = 0.5  # of a column that inflation fills from which the column reaches the support
MIRROR_WEIGHT = 0.7  # of the body against the columns above their underside, where these do not reach the support
RIM_SMOOTHING_PX, THICKNESS_SMOOTHING_PX = 2.0, 1.5  # both are doubled differences of depths, and as noisy
WIDE_M = 0.024  # half width from which a column that seems to reach the support does [m]
BAND = 3  # clamp of the field, in cells


def inflate(view: ObjectView) -> CarvedSurface:
    """Inflate what was seen of the object, carved by free space."""
    front, thickness = estimate_thickness(view)
    behind = backproject(front + thickness, view.camera)[view.own]
    hidden = transform_points(view.camera_to_table, behind)
    hidden = hidden[hidden[:, 2] > view.support_z]
    rectangle = fit_min_rectangle(np.concatenate([view.points[:, :2], hidden[:, :2]]))
    pose, half = place_frame(view, rectangle, rectangle.center)
    grid, stretch = build_flat_grid(view, half)
    local = grid.points() / np.array([1.0, 1.0, stretch])
    free = np.minimum(measure_free_space(view, local, pose), local[:, 2] + half[2]).reshape(grid.shape)
    near = ndimage.distance_transform_edt(~view.own) <= MARGIN_PX
    start, end = np.where(near, front, np.inf), front + thickness
    depth, (first, last) = sample_nearest(view, local, pose, (start, end))
    inside = np.minimum(depth - first, last - depth).reshape(grid.shape)
    footprint, z = find_footprint(view, pose, grid), grid.axes()[2] / stretch
    columns = compute_column_field(footprint, -half[2], z, free)
    resting = _find_resting(inside, columns, grid.cell)[:, :, None]
    between = MIRROR_WEIGHT * inside + (1.0 - MIRROR_WEIGHT) * columns
    reach = BAND * grid.cell
    field = np.clip(np.minimum(free, np.where(resting, np.maximum(inside, columns), between)), -reach, reach)
    field = close_floor(field, footprint, -half[2], z)
    return CarvedSurface(extract_surface(drop_crumbs(field), grid), stretch, grid.cell, pose)


def _find_resting(inside: Field, columns: Field, cell: float) -> Bool[np.ndarray, "nx ny"]:
    """Find the columns that reach the support: wide ones, and those that inflation fills for the most part."""
    solid = columns > 0.0
    layers = np.flatnonzero(solid.any(axis=(0, 1)))
    rests = solid[:, :, layers[0] if len(layers) else 0]
    filled = ((inside > 0.0) & solid).sum(axis=2) >= FILLED_SHARE * solid.sum(axis=2)
    within = ndimage.distance_transform_edt(np.pad(rests, 1))[1:-1, 1:-1]
    return np.asarray(rests & (filled | (compute_half_width(within) * cell > WIDE_M)))


def estimate_thickness(view: ObjectView) -> tuple[DepthImage, DepthImage]:
    """Estimate the depth at which each ray enters the object, and how far it leaves behind it [m].

    Of the nearest pixel with depth where there is none, of the object's nearest one beside it.
    """
    known = view.own & (view.depth > 0.0)
    if not known.any():
        raise GeometryError("no pixel of the object has depth")
    away, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    front = view.depth[nearest[0], nearest[1]]
    cloud = transform_points(view.camera_to_table, backproject(front, view.camera).reshape(-1, 3))
    settled = cloud[:, 2].reshape(front.shape) < view.support_z + SETTLED_M
    rim = ndimage.binary_dilation(view.past) & view.own & ~settled
    if not rim.any():
        raise GeometryError("no silhouette of the object was seen")
    from_rim = ndimage.distance_transform_edt(~rim, return_distances=False, return_indices=True)
    unread = away + 1.0
    beyond = _measure_outward_slope(view, front) * unread * front / view.camera.fx
    at_outline = front + _smooth_within(rim, beyond, RIM_SMOOTHING_PX)
    middle = _stretch_membrane(view.own, front, rim, at_outline[from_rim[0], from_rim[1]])
    lost = _estimate_lost_share(view, unread[from_rim[0], from_rim[1]])
    thickness = np.clip(2.0 * (middle - front) / (1.0 - lost), *THICKNESS_RANGE_M)
    thickness = _smooth_within(view.own, thickness, THICKNESS_SMOOTHING_PX)
    nearest = ndimage.distance_transform_edt(~view.own, return_distances=False, return_indices=True)
    return front, thickness[nearest[0], nearest[1]]


def _smooth_within(inside: Mask, values: DepthImage, sigma: float) -> DepthImage:
    """Smooth values inside a mask by a Gaussian of `sigma` pixels, without those outside."""
    weight = ndimage.gaussian_filter(inside.astype(float), sigma)
    return np.asarray(ndimage.gaussian_filter(np.where(inside, values, 0.0), sigma) / np.maximum(weight, 1e-9))


def _measure_outward_slope(view: ObjectView, front: DepthImage) -> DepthImage:
    """Measure the growth of depth towards the outline per lateral distance."""
    along_v, along_u = np.gradient(ndimage.gaussian_filter(view.outline_px, 1.0))
    step = INWARD_PX / np.maximum(np.hypot(along_v, along_u), 1e-6)
    v, u = np.indices(front.shape)
    inner = ndimage.map_coordinates(front, [v + step * along_v, u + step * along_u], order=1, mode="nearest")
    return np.clip((front - inner) * view.camera.fx / (INWARD_PX * front), -MAX_SLOPE, MAX_SLOPE)


def _estimate_lost_share(view: ObjectView, unread: DepthImage) -> DepthImage:
    """Estimate the share of half the thickness that a round section hides between its last reading and the outline.

    `unread` is the distance of the last reading from the outline [px]; the slope there was followed outward already.
    """
    radius = np.maximum(compute_half_width(np.where(view.own, np.maximum(view.outline_px, 0.0), 0.0)), 1.0)
    last, inner = (np.minimum(distance, radius) for distance in (unread, unread + INWARD_PX))
    rise, inner_rise = (np.sqrt(distance * (2 * radius - distance)) for distance in (last, inner))
    lost = rise - unread * (inner_rise - rise) / INWARD_PX
    return ndimage.gaussian_filter(np.clip(lost / radius, 0.0, MAX_LOST), 2.0)


def _stretch_membrane(own: Mask, front: DepthImage, rim: Mask, at_rim: DepthImage) -> DepthImage:
    """Solve Laplace's equation for the object's middle depth, given at the rim [m]; on a coarse raster of pixels."""
    step = max(1, int(np.ceil(np.sqrt(own.sum() / MEMBRANE_PIXELS))))
    start = step // 2
    raster = (slice(start, None, step), slice(start, None, step))
    wide_rim = ndimage.maximum_filter(rim, size=2 * start + 1)[raster]
    inside, depth = own[raster], front[raster]
    fixed, level, links = _cut_at_steps(inside, depth, wide_rim & inside, at_rim[raster])
    if not fixed.any():
        raise GeometryError("the object's silhouette is too small to stretch a membrane over it")
    count = int(inside.sum())
    rows, columns = np.concatenate([links, links[::-1]], axis=1)
    free = ~fixed[inside][rows]
    rows, columns, every = rows[free], columns[free], np.arange(count)
    # What no link joins to the rim keeps its own depth.
    own_weight = np.where(fixed[inside], 1.0, 1e-6)
    values = np.concatenate([np.ones(len(rows)), -np.ones(len(rows)), own_weight])
    at = (np.concatenate([rows, rows, every]), np.concatenate([rows, columns, every]))
    system = coo_array((values, at), shape=(count, count)).tocsc()
    solved = depth.copy()
    solved[inside] = spsolve(system, own_weight * np.where(fixed, level, depth)[inside])
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    pixels = (np.indices(front.shape) - start) / step
    return np.asarray(ndimage.map_coordinates(solved[nearest[0], nearest[1]], pixels, order=1, mode="nearest"))


def _cut_at_steps(
    inside: Mask, depth: DepthImage, fixed: Mask, level: DepthImage
) -> tuple[Mask, DepthImage, Int64[np.ndarray, "2 k"]]:
    """Add the near sides of steps to the rim; return it, its depth and the pairs of pixels that are joined."""
    fixed, level, links = fixed.copy(), level.copy(), []
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(int(inside.sum()))
    whole, but_last, but_first = slice(None), slice(None, -1), slice(1, None)
    for one, two in (((but_last, whole), (but_first, whole)), ((whole, but_last), (whole, but_first))):
        both, gap = inside[one] & inside[two], depth[two] - depth[one]
        for near, beyond in ((one, gap), (two, -gap)):
            ends = both & (beyond > STEP_M) & ~fixed[near]
            level[near][ends] = (depth[near] + np.minimum(0.5 * beyond + OVERLAP_M, HIDDEN_M))[ends]
            fixed[near] |= ends
        joined = both & (np.abs(gap) <= STEP_M)
        links.append(np.stack([number[one][joined], number[two][joined]]))
    return fixed, level, np.concatenate(links, axis=1)
