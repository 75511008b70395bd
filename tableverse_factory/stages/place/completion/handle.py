"""What a surface of revolution leaves unexplained: handles and spouts, as thick as they look wide."""

import numpy as np
import open3d as o3d
from jaxtyping import Float64
from manifold3d import Manifold
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.geometry import IdImage, Mask, Points
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.voxel_solids import (
    extract_surface,
    find_largest_part,
    from_manifold,
    make_grid,
    to_manifold,
)
from tableverse_factory.stages.place.completion.half_width import compute_half_width
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space

AWAY_M = 0.004
"""Points farther than this outside of the body belong to something else."""
MIN_PIXELS = 30
MIN_SHARE = 0.025
RADIUS_RANGE_M = (0.002, 0.012)
CELL_M = 0.0015
MAX_CELLS = 250_000
MAX_BRIDGE_M = 0.06
BRIDGE_RADIUS_M = 0.005
NEIGHBOURS = 8


def add_handles(sighting: ObjectView, body: Manifold, hole: Manifold | None) -> Manifold:
    """The body joined with what was seen to stick out of it, its cavity left free; all in the table frame."""
    mask = _find_protrusions(sighting, body)
    for label in range(1, int(mask.max(initial=0)) + 1):
        part = _sweep_part(sighting, mask == label)
        if part is None:
            continue
        joined = _join_part(body, part)
        body = joined if hole is None else joined - hole
    return find_largest_part(body)


def _join_part(body: Manifold, part: Manifold) -> Manifold:
    """The union, with a straight bridge where something hid how the part is attached."""
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
    bridge = Manifold.batch_hull([ball.translate(tuple(start)), ball.translate(tuple(end))])
    return joined + bridge


def _find_protrusions(sighting: ObjectView, body: Manifold) -> IdImage:
    """Labels, over the window, of the parts of the object that lie outside of the body."""
    mesh = from_manifold(body)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces))
    queries = o3d.core.Tensor.from_numpy(sighting.points.astype(np.float32))
    away = scene.compute_signed_distance(queries, nthreads=1).numpy() > AWAY_M
    mask = _rasterize(sighting, sighting.points[away])
    grown = ndimage.binary_dilation(ndimage.binary_opening(mask), iterations=2) & sighting.own
    labels, count = ndimage.label(grown)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    least = max(MIN_PIXELS, MIN_SHARE * float(sighting.own.sum()))
    keep = [k for k in range(1, count + 1) if sizes[k] >= least]
    result = np.zeros(labels.shape, dtype=np.int32)
    for new, old in enumerate(keep, start=1):
        result[labels == old] = new
    return result


def _rasterize(sighting: ObjectView, points: Points) -> Mask:
    mask = np.zeros(sighting.own.shape, dtype=bool)
    if len(points):
        pixels = np.rint(project(transform_points(invert_pose(sighting.camera_to_table), points), sighting.camera))
        column, row = pixels.astype(int)[:, 0], pixels.astype(int)[:, 1]
        height, width = sighting.camera.height, sighting.camera.width
        mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] = True
    return mask


def _sweep_part(sighting: ObjectView, mask: Mask) -> Manifold | None:
    """Balls behind each of the part's points, as thick as the part looks wide, carved by free space."""
    own = _rasterize(sighting, sighting.points)
    width = compute_half_width(ndimage.distance_transform_edt(mask))
    index = np.rint(project(transform_points(invert_pose(sighting.camera_to_table), sighting.points), sighting.camera))
    column, row = index.astype(int)[:, 0], index.astype(int)[:, 1]
    inside = mask[np.clip(row, 0, own.shape[0] - 1), np.clip(column, 0, own.shape[1] - 1)]
    points = sighting.points[inside]
    if len(points) < MIN_PIXELS:
        return None
    rays = points - sighting.eye
    depth = np.linalg.norm(rays, axis=1)
    pixels = width[row[inside], column[inside]]
    radius = np.clip(pixels * depth / sighting.camera.fx, *RADIUS_RANGE_M)
    centers = points + rays / depth[:, None] * radius[:, None]
    return _build_balls(sighting, centers, radius)


def _build_balls(sighting: ObjectView, centers: Points, radius: Float64[np.ndarray, " n"]) -> Manifold | None:
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
    ball = np.minimum(np.minimum(ball, measure_free_space(sighting, samples)), samples[:, 2] - sighting.support_z)
    field = np.full(int(np.prod(grid.shape)), -2 * cell)
    field[near] = ball
    try:
        return to_manifold(extract_surface(field.reshape(grid.shape), grid)).simplify(0.1 * cell)
    except GeometryError:
        return None
