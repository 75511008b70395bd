"""Quality of convex pieces: volume, distances to the mesh, uncovered parts, cavities kept."""

from collections.abc import Sequence
from dataclasses import replace

import manifold3d
import numpy as np
from jaxtyping import Float64
from trimesh.triangles import closest_point

from schemas.geometry import ConvexPieces, Points, TriangleMesh
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.hulls import compute_face_heights, unite_hulls
from tableverse_factory.geometry.mesh.repair import solid_to_mesh
from tableverse_factory.geometry.mesh.surface_samples import find_largest_distance_to_surface, sample_surface

SAMPLES = 10_000
MAX_POINTS = 30_000
INSIDE_TOLERANCE = 1e-9
MIN_CAVITY_SHARE = 0.01  # share of the hull's volume below which there is no cavity to keep


def add_metrics(pieces: ConvexPieces, solid: manifold3d.Manifold) -> ConvexPieces:
    """Measure pieces against the solid that they stand for."""
    union = unite_hulls(pieces.hulls)
    mesh, around = solid_to_mesh(solid), solid_to_mesh(union)
    stride = -(-len(mesh.vertices) // MAX_POINTS)
    points = np.concatenate([mesh.vertices[::stride], sample_surface(mesh, SAMPLES)[0]])
    uncovered = float(measure_distance_to_pieces(points, pieces.hulls).max())
    back = find_largest_distance_to_surface(sample_surface(around, SAMPLES)[0], mesh, 2 * SAMPLES)
    volume, filled, hull = float(solid.volume()), float(union.volume()), float(solid.hull().volume())
    cavity = hull - volume
    return replace(
        pieces,
        volume_ratio=filled / volume,
        hausdorff_m=max(uncovered, back),
        uncovered_m=uncovered,
        cavity_kept=float(np.clip((hull - filled) / cavity, 0.0, 1.0)) if cavity > MIN_CAVITY_SHARE * hull else 1.0,
    )


def measure_distance_to_pieces(points: Points, hulls: Sequence[TriangleMesh]) -> Float64[np.ndarray, " n"]:
    """Measure the distance of each point to the nearest piece, 0 inside."""
    outside = np.ones(len(points), dtype=bool)
    for hull in hulls:
        low, high = aabb(hull.vertices)
        in_box = (points >= low - INSIDE_TOLERANCE).all(axis=1) & (points <= high + INSIDE_TOLERANCE).all(axis=1)
        near = np.flatnonzero(outside & in_box)
        outside[near] = compute_face_heights(hull, points[near]).max(axis=1) > INSIDE_TOLERANCE
    distances = np.zeros(len(points))
    distances[outside] = _measure_distance_outside(points[outside], hulls)
    return distances


def _measure_distance_outside(points: Points, hulls: Sequence[TriangleMesh]) -> Float64[np.ndarray, " n"]:
    """Measure the distance of points outside all hulls to the nearest; boxes limit the hulls that are tried."""
    corners = [aabb(hull.vertices) for hull in hulls]
    beyond = (np.maximum(np.maximum(low - points, points - high), 0.0) for low, high in corners)
    boxes = np.stack([np.linalg.norm(each, axis=1) for each in beyond], axis=1)
    nearest = np.argmin(boxes, axis=1)
    distances = np.full(len(points), np.inf)
    for k, hull in enumerate(hulls):
        mine = nearest == k
        distances[mine] = _measure_distance_to_hull(points[mine], hull)
    for k, hull in enumerate(hulls):
        nearer = np.flatnonzero((nearest != k) & (boxes[:, k] < distances))
        distances[nearer] = np.minimum(distances[nearer], _measure_distance_to_hull(points[nearer], hull))
    return distances


def _measure_distance_to_hull(points: Points, hull: TriangleMesh) -> Float64[np.ndarray, " n"]:
    """Measure the distance to a hull, 0 inside: the nearest point lies on a face that the point sees."""
    point, face = np.nonzero(compute_face_heights(hull, points) > INSIDE_TOLERANCE)
    apart = closest_point(hull.vertices[hull.faces[face]], points[point]) - points[point]
    distances = np.full(len(points), np.inf)
    np.minimum.at(distances, point, np.linalg.norm(apart, axis=1))
    return np.where(np.isinf(distances), 0.0, distances)
