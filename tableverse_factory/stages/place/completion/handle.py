"""Handles and spouts: parts outside a surface of revolution, as thick as they look wide."""

import numpy as np
from jaxtyping import Float64
from manifold3d import Manifold
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.geometry import IdImage, Mask, Points
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, to_tensor
from tableverse_factory.geometry.mesh.voxel_solids import (
    extract_surface,
    find_largest_part,
    from_manifold,
    make_grid,
    to_manifold,
)
from tableverse_factory.stages.place.completion.underside import compute_half_width
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space

AWAY_M = 0.004  # distance outside the body from which points belong to another part [m]
MIN_PIXELS = 30
MIN_SHARE = 0.025
RADIUS_RANGE_M = (0.002, 0.012)
CELL_M = 0.0015
MAX_CELLS = 250_000
MAX_BRIDGE_M = 0.06
BRIDGE_RADIUS_M = 0.005
NEIGHBOURS = 8


def add_handles(view: ObjectView, body: Manifold, hole: Manifold | None) -> Manifold:
    """Join the body with the protrusions observed, its cavity left free; all in the table frame."""
    mask = _find_protrusions(view, body)
    for label in range(1, int(mask.max(initial=0)) + 1):
        part = _sweep_part(view, mask == label)
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


def _find_protrusions(view: ObjectView, body: Manifold) -> IdImage:
    """Label the parts of the object that lie outside the body, over the window."""
    scene = make_raycasting_scene(from_manifold(body))
    away = scene.compute_signed_distance(to_tensor(view.points), nthreads=1).numpy() > AWAY_M
    mask: Mask = np.zeros(view.own.shape, dtype=bool)
    row, column = _find_pixels(view, view.points[away])
    mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)] = True
    grown = ndimage.binary_dilation(ndimage.binary_opening(mask), iterations=2) & view.own
    labels, count = ndimage.label(grown)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    least = max(MIN_PIXELS, MIN_SHARE * float(view.own.sum()))
    kept = [k for k in range(1, count + 1) if sizes[k] >= least]
    number = np.zeros(count + 1, dtype=np.int32)
    number[kept] = np.arange(1, len(kept) + 1)
    return number[labels]


def _find_pixels(view: ObjectView, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Find row and column of points of the table frame in the window, not clipped."""
    pixels = np.rint(project(transform_points(invert_pose(view.camera_to_table), points), view.camera)).astype(int)
    return pixels[:, 1], pixels[:, 0]


def _sweep_part(view: ObjectView, mask: Mask) -> Manifold | None:
    """Sweep balls behind each of the part's points, as thick as the part looks wide, carved by free space."""
    width = compute_half_width(ndimage.distance_transform_edt(mask))
    row, column = _find_pixels(view, view.points)
    inside = mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)]
    points = view.points[inside]
    if len(points) < MIN_PIXELS:
        return None
    rays = points - view.eye
    depth = np.linalg.norm(rays, axis=1)
    pixels = width[row[inside], column[inside]]
    radius = np.clip(pixels * depth / view.camera.fx, *RADIUS_RANGE_M)
    centers = points + rays / depth[:, None] * radius[:, None]
    return _build_balls(view, centers, radius)


def _build_balls(view: ObjectView, centers: Points, radius: Float64[np.ndarray, " n"]) -> Manifold | None:
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
    ball = np.minimum(np.minimum(ball, measure_free_space(view, samples)), samples[:, 2] - view.support_z)
    field = np.full(int(np.prod(grid.shape)), -2 * cell)
    field[near] = ball
    try:
        return to_manifold(extract_surface(field.reshape(grid.shape), grid)).simplify(0.1 * cell)
    except GeometryError:
        return None
