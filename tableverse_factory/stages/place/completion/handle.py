"""Handles and spouts: parts outside a surface of revolution, as thick as they look wide."""

from contextlib import suppress

import numpy as np
from jaxtyping import Bool, Float64
from manifold3d import Manifold
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.geometry import IdImage, Mask, Points, Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.camera import backproject, project
from tableverse_factory.geometry.math.transforms import (
    invert_pose,
    matrix_from_pose,
    rotation_matrix,
    transform_points,
)
from tableverse_factory.geometry.mesh.raycasting import (
    RaycastingScene,
    make_raycasting_scene,
    pack_pixel_rays,
    to_tensor,
)
from tableverse_factory.geometry.mesh.voxel_solids import (
    extract_surface,
    find_largest_part,
    from_manifold,
    make_grid,
    simplify_solid,
    to_manifold,
)
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, compute_mesh_misfit
from tableverse_factory.stages.place.completion.underside import compute_half_width
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space

HANDLE_FREEDOM = 0.2  # cost of handles, as a share of the misfit that they remove: they complete only a good body
# A body with its handles has no more tunnels, or all parts together no more misfit [m]: of scans, whose handles 1 mm of
# noise tears as well, it is 0.5 to 0.7 mm, of smeared ones 1.4 to 1.7
MOST_HANDLE_TUNNELS, CLEAR_M = 5, 0.0012
WORTH_HANDLES_M = 0.004  # misfit from which the body is wrong and the rest is no handle [m]
MAX_FACES = 3200
TOLERANCE_M = 0.00005
AWAY_M = 0.004  # distance outside the body from which points belong to another part [m]
FRAYED_PX = 2  # by which an outline that a net drew is ragged; a handle under twice that width is lost
MIN_PIXELS = 30
MIN_SHARE = 0.025
MIN_REACH = 0.15  # of a handle from the body, as a share of its extent: 0.36 and more of five; strips have under 0.1
RADIUS_RANGE_M = (0.002, 0.012)
CELL_M = 0.0015
MAX_CELLS = 250_000
MAX_BRIDGE_M = 0.06
BRIDGE_RADIUS_M = 0.005
NEIGHBOURS = 8
ALONG_AXIS = 0.5  # sine of the angle between axis and line of sight up to which a handle stands before the body
MAX_GAP_M = 0.06  # between what is seen of a part and what goes on of it: a cup's handle is seldom longer
MEDIAL_SHARE = 0.6  # of the half width, from which a pixel is amid the part: balls of others would bulge the outline
LEAST_ASIDE = 0.7  # mean of a part's points, as a share of their mean distance from the axis: a ring has no plane
LEAST_CROSSING = (
    0.3  # sine of the angle at which a ray must cross a part's plane: errors of the plane grow by its inverse
)
MOST_POINTS = 0.95  # share of a part's points that must lie near its plane
MOST_MOVED = 0.35  # of a point's distance from the camera, into that plane


def join_handles(
    view: ObjectView, rays: RaySample, body: Manifold, hole: Manifold | None, axis: Pose
) -> tuple[TriangleMesh, Pose, float]:
    """Join a body, in the frame of `axis`, with its handles, if they explain the picture better; its `hole` stays free.

    Where errors of the depth tear the handles, those of the silhouette take their place, if they are better than none.

    Returns the mesh about the middle of its box, its pose in the table frame, and its misfit with the cost of handles
    [m]: of those that follow the depth, as what takes their place says nothing about the body.
    """
    to_table = matrix_from_pose(axis)[:3]
    body, hole = body.transform(to_table), None if hole is None else hole.transform(to_table)
    bare = _center(body, axis)
    cost = compute_mesh_misfit(rays, *bare)
    if cost >= WORTH_HANDLES_M:
        return *bare, cost
    solid = _add_handles(view, body, hole, axis, by_outline=rays.estimated)
    whole = _center_simplified(solid, axis)
    better = compute_mesh_misfit(rays, *whole)
    if better >= cost:
        return *bare, cost
    if not rays.estimated and solid.genus() > MOST_HANDLE_TUNNELS and better > CLEAR_M:
        whole = bare
        with suppress(GeometryError):  # the body is a shape without them
            drawn = _center_simplified(_add_handles(view, body, hole, axis, by_outline=True), axis)
            whole = drawn if compute_mesh_misfit(rays, *drawn) < cost else bare
    return *whole, better + HANDLE_FREEDOM * (cost - better)


def _center_simplified(solid: Manifold, axis: Pose) -> tuple[TriangleMesh, Pose]:
    return _center(simplify_solid(solid, MAX_FACES, TOLERANCE_M), axis)


def _center(solid: Manifold, axis: Pose) -> tuple[TriangleMesh, Pose]:
    mesh = from_manifold(solid)
    vertices = transform_points(invert_pose(axis), mesh.vertices)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    pose = Pose(transform_points(axis, middle[None])[0], axis.quaternion_wxyz)
    return TriangleMesh(vertices - middle, mesh.faces), pose


def _add_handles(view: ObjectView, body: Manifold, hole: Manifold | None, axis: Pose, *, by_outline: bool) -> Manifold:
    """Join the body with the protrusions observed, its cavity left free; all in the table frame."""
    scene = make_raycasting_scene(from_manifold(body))
    mask = _find_protrusions(view, scene, by_outline=by_outline)
    for label in range(1, int(mask.max(initial=0)) + 1):
        part = _sweep_part(view, mask == label, axis, by_outline=by_outline)
        if part is None:
            continue
        joined = _join_part(body, part)
        body = joined if hole is None else joined - hole
    return find_largest_part(body)


def _join_part(body: Manifold, part: Manifold) -> Manifold:
    """Unite the two, with a straight bridge where the attachment was hidden."""
    joined = body + part
    if len(joined.decompose()) == 1:
        return joined
    ours, theirs = from_manifold(body).vertices, from_manifold(part).vertices
    distance, index = cKDTree(ours).query(theirs)
    nearest = int(np.argmin(distance))
    if distance[nearest] > MAX_BRIDGE_M:
        return body
    start, end = ours[index[nearest]], theirs[nearest]
    ball = Manifold.sphere(BRIDGE_RADIUS_M, 12)
    return joined + Manifold.batch_hull([ball.translate(tuple(start)), ball.translate(tuple(end))])


def _find_protrusions(view: ObjectView, scene: RaycastingScene, *, by_outline: bool) -> IdImage:
    """Label the parts of the object that lie outside the body, over the window.

    A sensor's points tell of them, which go on beside the silhouette where it reads nothing. Of estimated depth the
    silhouette alone tells: it is off by more than a handle is thick.
    """
    rays = pack_pixel_rays(view.camera, view.camera_to_table)
    covered = np.isfinite(scene.cast_rays(rays, nthreads=1)["t_hit"].numpy())
    from_body = np.asarray(ndimage.distance_transform_edt(~covered))
    beside = _find_uncovered(view, from_body)
    told = _open_gaps(view, beside, covered) if by_outline else _find_away(view, scene)
    labels, count = ndimage.label(told if by_outline else told | (beside & view.unread))
    sizes = np.bincount(labels[told], minlength=count + 1)  # that of no part is 0, as all that is told has a label
    least = max(MIN_PIXELS, MIN_SHARE * float(view.own.sum()))
    number = np.zeros(count + 1, dtype=np.int32)
    for label in np.flatnonzero(sizes >= least):
        part = labels == label
        # A body that is too narrow leaves a strip along its side
        if not by_outline or float(from_body[part].max()) >= MIN_REACH * _measure_extent(part):
            number[label] = number.max() + 1
    return number[labels]


def _find_away(view: ObjectView, scene: RaycastingScene) -> Mask:
    """Find the object's pixels whose points lie outside the body, and those beside them."""
    away = scene.compute_signed_distance(to_tensor(view.points), nthreads=1).numpy() > AWAY_M
    mask: Mask = np.zeros(view.own.shape, dtype=bool)
    row, column = _find_pixels(view, view.points[away])
    mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)] = True
    return ndimage.binary_dilation(ndimage.binary_opening(mask), iterations=2) & view.own


def _measure_extent(mask: Mask) -> float:
    return float(np.linalg.norm(np.ptp(np.argwhere(mask), axis=0)))


def _find_uncovered(view: ObjectView, from_body: Float64[np.ndarray, "h w"]) -> Mask:
    """Find the object's pixels beside the body's silhouette, and those between; `from_body` is the distance [px]."""
    shown = view.own | view.unread
    away_px = AWAY_M * view.camera.fx / float(np.median(np.linalg.norm(view.points - view.eye, axis=1)))
    core = ndimage.binary_opening(shown & (from_body > away_px), iterations=FRAYED_PX)
    return ndimage.binary_dilation(core, iterations=FRAYED_PX + int(np.ceil(away_px))) & shown


def _open_gaps(view: ObjectView, beside: Mask, covered: Mask) -> Mask:
    """Leave out what handles and body enclose in the colours of the background: a net's mask often fills it."""
    solid = (beside & ~view.background_colors) | covered
    return beside & ~(ndimage.binary_fill_holes(solid) & ~solid)


def _find_pixels(view: ObjectView, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Find row and column of points of the table frame in the window, not clipped."""
    pixels = np.rint(project(transform_points(invert_pose(view.camera_to_table), points), view.camera)).astype(int)
    return pixels[:, 1], pixels[:, 0]


def _sweep_part(view: ObjectView, mask: Mask, axis: Pose, *, by_outline: bool) -> Manifold | None:
    """Sweep balls along the part, as thick as it looks wide: behind each of its points, carved by free space.

    By its outline they go along the middle of the part, in a plane through the axis, if the camera does not look along
    it, and nothing is carved.
    """
    inset = ndimage.distance_transform_edt(mask)
    width = compute_half_width(inset)
    row, column = _find_pixels(view, view.points)
    row, column = np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)
    inside = mask[row, column]
    if np.count_nonzero(inside) < MIN_PIXELS:
        return None
    points, inset_px, width_px = (of[inside] for of in (view.points, inset[row, column], width[row, column]))
    amid = inset_px > MEDIAL_SHARE * width_px
    if by_outline and np.count_nonzero(amid) >= MIN_PIXELS:
        flat = _move_into_plane(view, points[amid], axis)
        if flat is not None:
            return _build_balls(view, flat, _measure_radius(view, flat, inset_px[amid]), carve=False)
    radius = _measure_radius(view, points, width_px)
    rays = points - view.eye
    centers = points + rays / np.linalg.norm(rays, axis=1)[:, None] * radius[:, None]
    part = _build_balls(view, centers, radius, carve=True)
    if part is None:
        return None
    unread = mask & view.unread & (inset > MEDIAL_SHARE * width)
    more, known = _continue_in_plane(view, unread, centers, axis)
    if not len(more):
        return part
    # Along their middle, as wide as the mask there: no free space cuts what the sensor does not see
    rest = _build_balls(view, more, _measure_radius(view, more, inset[unread][known]), carve=False)
    return part if rest is None else part + rest


def _measure_radius(view: ObjectView, points: Points, pixels: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Measure radii at points, of so many pixels [m]."""
    depth = np.linalg.norm(points - view.eye, axis=1)
    return np.clip(pixels * depth / view.camera.fx, *RADIUS_RANGE_M)


def _continue_in_plane(
    view: ObjectView, unread: Mask, centers: Points, axis: Pose
) -> tuple[Points, Bool[np.ndarray, " n"]]:
    """Place pixels without a reading in the half plane from the axis in which the centres of a part lie.

    Returns the points, and which of the pixels they are of: those whose rays cross it, near the part. None are where
    the part stands all around the axis.
    """
    to_axis, turn = invert_pose(axis), rotation_matrix(axis.quaternion_wxyz)
    ends = backproject(unread.astype(np.float64), view.camera)[unread]
    rays = transform_points(view.camera_to_table, ends) - view.eye
    across = transform_points(to_axis, centers)[:, :2]
    away, spread = across.mean(axis=0), float(np.linalg.norm(across, axis=1).mean())
    normal = np.array([-away[1], away[0]]) / max(float(np.linalg.norm(away)), 1e-9)
    eye, slope = transform_points(to_axis, view.eye[None])[0, :2], (rays @ turn)[:, :2] @ normal
    crosses = np.abs(slope) > LEAST_CROSSING * np.linalg.norm(rays, axis=1)
    share = -(eye @ normal) / np.where(crosses, slope, 1.0)
    points = view.eye + rays * share[:, None]
    near = np.isfinite(cKDTree(centers).query(points, distance_upper_bound=MAX_GAP_M)[0])
    known = (
        (np.linalg.norm(away) > LEAST_ASIDE * spread)
        & crosses
        & near
        & (share > 0.0)
        & (transform_points(to_axis, points)[:, :2] @ away > 0.0)
    )
    return points[known], known


def _move_into_plane(view: ObjectView, points: Points, axis: Pose) -> Points | None:
    """Move a part's points along their rays into the plane through the axis that lies across the line of sight.

    A silhouette does not tell about how much a handle turns out of that plane. None where the camera looks along the
    axis, or most points lie far from the plane.
    """
    eye = transform_points(invert_pose(axis), view.eye[None])[0, :2]
    rays = points - view.eye
    across = (rays @ rotation_matrix(axis.quaternion_wxyz))[:, :2]
    sight = across.mean(axis=0)
    if float(np.linalg.norm(sight)) < ALONG_AXIS * float(np.linalg.norm(rays, axis=1).mean()):
        return None
    share = -(eye @ sight) / (across @ sight)
    if float(np.quantile(np.abs(share - 1.0), MOST_POINTS)) > MOST_MOVED:
        return None
    return view.eye + rays * np.clip(share, 1.0 - MOST_MOVED, 1.0 + MOST_MOVED)[:, None]


def _build_balls(
    view: ObjectView, centers: Points, radius: Float64[np.ndarray, " n"], *, carve: bool
) -> Manifold | None:
    reach = float(radius.max()) + CELL_M
    low, high = centers.min(axis=0) - reach, centers.max(axis=0) + reach
    cell = max(CELL_M, float(np.cbrt(np.prod(high - low) / MAX_CELLS)))
    grid = make_grid(low, high, cell)
    empty = np.ones(grid.shape, dtype=bool)
    empty[tuple(np.rint((centers - grid.origin) / cell).astype(int).T)] = False
    near = np.flatnonzero(ndimage.distance_transform_edt(empty) * cell < reach + cell)
    samples = grid.points()[near]
    count = min(NEIGHBOURS, len(centers))
    distance, index = cKDTree(centers).query(samples, k=count)
    ball = (radius[np.reshape(index, (-1, count))] - np.reshape(distance, (-1, count))).max(axis=1)
    ball = np.minimum(ball, samples[:, 2] - view.support_z)
    if carve:
        ball = np.minimum(ball, measure_free_space(view, samples))
    field = np.full(int(np.prod(grid.shape)), -2 * cell)
    field[near] = ball
    try:
        return to_manifold(extract_surface(field.reshape(grid.shape), grid)).simplify(0.1 * cell)
    except GeometryError:
        return None
