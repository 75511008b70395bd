"""Vertex colours from the picture: what was seen where it was seen, the nearest of it elsewhere."""

import numpy as np
from scipy.spatial import cKDTree

from schemas.geometry import Colors, Points, Pose, TriangleMesh
from tableverse_factory.geometry.transforms import transform_points
from tableverse_factory.place.sighting import Sighting

NEIGHBOURS = 6


def painted(mesh: TriangleMesh, pose: Pose, sighting: Sighting) -> TriangleMesh:
    """The mesh with a colour per vertex, from the observed points nearest to it."""
    vertices = transform_points(pose, mesh.vertices)
    return TriangleMesh(mesh.vertices, mesh.faces, _nearest_colors(vertices, sighting))


def _nearest_colors(vertices: Points, sighting: Sighting) -> Colors:
    count = min(NEIGHBOURS, len(sighting.points))
    distance, index = cKDTree(sighting.points).query(vertices, k=count)
    distance, index = np.reshape(distance, (-1, count)), np.reshape(index, (-1, count))
    weight = 1.0 / (distance + 1e-3)
    weight /= weight.sum(axis=1, keepdims=True)
    mixed = (weight[:, :, None] * sighting.colors[index].astype(np.float64)).sum(axis=1)
    return np.ascontiguousarray(np.rint(mixed).astype(np.uint8))
