"""How well convex pieces stand for a mesh: volume, distances, what sticks out, what stays open."""

from collections.abc import Sequence
from dataclasses import replace

import manifold3d
import numpy as np
from jaxtyping import Float64
from trimesh.triangles import closest_point

from schemas.geometry import ConvexPieces, Points, TriangleMesh
from tableverse_factory.geometry.mesh.hulls import face_heights, hull_of, protrusion
from tableverse_factory.geometry.mesh.repair import as_mesh
from tableverse_factory.geometry.mesh.surface_samples import distance_to_surface, surface_samples

SAMPLES = 10_000
MAX_POINTS = 30_000
INSIDE = 1e-9
LEAST_CAVITY = 0.01
"""Share of the hull's volume below which there is no cavity to keep."""


def with_metrics(pieces: ConvexPieces, solid: manifold3d.Manifold) -> ConvexPieces:
    """The pieces with their figures, measured against the solid they stand for."""
    hulls = [hull_of(hull.vertices) for hull in pieces.hulls]
    union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
    mesh, around = as_mesh(solid), as_mesh(union)
    stride = -(-len(mesh.vertices) // MAX_POINTS)
    points = np.concatenate([mesh.vertices[::stride], surface_samples(mesh, SAMPLES)[0]])
    uncovered = float(distance_to_pieces(points, pieces.hulls).max())
    back = float(distance_to_surface(surface_samples(around, SAMPLES)[0], mesh, 2 * SAMPLES).max())
    volume, filled, hull = float(solid.volume()), float(union.volume()), float(solid.hull().volume())
    cavity = hull - volume
    return replace(
        pieces,
        volume_ratio=filled / volume,
        hausdorff_m=max(uncovered, back),
        uncovered_m=uncovered,
        cavity_kept=float(np.clip((hull - filled) / cavity, 0.0, 1.0)) if cavity > LEAST_CAVITY * hull else 1.0,
    )


def distance_to_pieces(points: Points, hulls: Sequence[TriangleMesh]) -> Float64[np.ndarray, " n"]:
    """Distance of each point to the nearest piece, 0 inside."""
    outside = np.ones(len(points), dtype=bool)
    for hull in hulls:
        low, high = hull.vertices.min(axis=0), hull.vertices.max(axis=0)
        near = np.flatnonzero(outside & (points >= low - INSIDE).all(axis=1) & (points <= high + INSIDE).all(axis=1))
        outside[near] = protrusion(hull, points[near])[0] > INSIDE
    distances = np.zeros(len(points))
    distances[outside] = _to_nearest(points[outside], hulls)
    return distances


def _to_nearest(points: Points, hulls: Sequence[TriangleMesh]) -> Float64[np.ndarray, " n"]:
    """Distance of points that lie in none of the hulls to the nearest; a hull is looked at where its box is near."""
    boxes = np.stack([_to_box(points, hull) for hull in hulls], axis=1)
    nearest = np.argmin(boxes, axis=1)
    distances = np.full(len(points), np.inf)
    for k, hull in enumerate(hulls):
        mine = nearest == k
        distances[mine] = _to_hull(points[mine], hull)
    for k, hull in enumerate(hulls):
        nearer = np.flatnonzero((nearest != k) & (boxes[:, k] < distances))
        distances[nearer] = np.minimum(distances[nearer], _to_hull(points[nearer], hull))
    return distances


def _to_box(points: Points, hull: TriangleMesh) -> Float64[np.ndarray, " n"]:
    low, high = hull.vertices.min(axis=0), hull.vertices.max(axis=0)
    beyond: Float64[np.ndarray, " n"] = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
    return beyond


def _to_hull(points: Points, hull: TriangleMesh) -> Float64[np.ndarray, " n"]:
    """Distance to a hull, 0 inside: what is nearest lies on a face that the point sees."""
    point, face = np.nonzero(face_heights(hull, points) > INSIDE)
    apart = closest_point(hull.vertices[hull.faces[face]], points[point]) - points[point]
    distances = np.full(len(points), np.inf)
    np.minimum.at(distances, point, np.linalg.norm(apart, axis=1))
    return np.where(np.isinf(distances), 0.0, distances)
