"""How well convex pieces stand for a mesh: volume, distances, what sticks out, what stays open."""

from collections.abc import Sequence
from dataclasses import replace

import manifold3d
import numpy as np
from jaxtyping import Float64
from trimesh.triangles import closest_point

from schemas.geometry import ConvexPieces, Points, TriangleMesh
from tableverse_factory.geometry.hulls import hull_of, protrusion
from tableverse_factory.geometry.repair import as_mesh
from tableverse_factory.geometry.samples import distance_to_surface, surface_samples

SAMPLES = 10_000
MAX_POINTS = 30_000
INSIDE = 1e-9
LEAST_CAVITY = 0.01
"""Share of the hull's volume below which there is no cavity to keep."""


def measured(pieces: ConvexPieces, solid: manifold3d.Manifold) -> ConvexPieces:
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
    left = points[outside]
    if len(left) > 0:
        distances[outside] = np.min([_to_faces(left, hull) for hull in hulls], axis=0)
    return distances


def _to_faces(points: Points, hull: TriangleMesh) -> Float64[np.ndarray, " n"]:
    """Distance of points outside to the surface of a hull."""
    triangles = np.tile(hull.vertices[hull.faces], (len(points), 1, 1))
    repeated = np.repeat(points, len(hull.faces), axis=0)
    distances = np.linalg.norm(closest_point(triangles, repeated) - repeated, axis=1)
    smallest: Float64[np.ndarray, " n"] = distances.reshape(len(points), -1).min(axis=1)
    return smallest
