"""Deterministic, evenly spread samples of a surface, and distances to it."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from schemas.geometry import Points, TriangleMesh

_R2_FIRST = 0.7548776662466927  # the plastic number's inverse and its square: a sequence that fills the unit square
_R2_SECOND = 0.5698402909980532
_NEAREST = 8  # samples whose triangles a point is measured to
_BATCH = 256  # points measured at once
_ROUNDING_M = 1e-12  # a sample lies on its triangle up to this


def sample_surface(mesh: TriangleMesh, count: int) -> tuple[Points, Int64[np.ndarray, " n"]]:
    """Sample `count` points by area, the same for the same mesh, with the triangle of each.

    A mesh without area gives the first corner of every triangle.
    """
    areas = _compute_doubled_areas(mesh)
    if not areas.sum() > 0.0:
        return mesh.vertices[mesh.faces[:, 0]], np.arange(len(mesh.faces))
    ends = np.cumsum(areas) / areas.sum()
    triangle = np.minimum(np.searchsorted(ends, (np.arange(count) + 0.5) / count), len(areas) - 1)
    u, v = (np.arange(count) * _R2_FIRST) % 1.0, (np.arange(count) * _R2_SECOND) % 1.0
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u)[:, None], np.where(fold, 1.0 - v, v)[:, None]
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    return a + u * (b - a) + v * (c - a), triangle


def compute_surface_area(mesh: TriangleMesh) -> float:
    """Compute the area of all triangles [m²]."""
    return float(_compute_doubled_areas(mesh).sum()) / 2


def _compute_doubled_areas(mesh: TriangleMesh) -> Float64[np.ndarray, " m"]:
    """Compute twice the areas, by coordinates: numpy's cross product of rows takes four times as long."""
    columns = np.ascontiguousarray(mesh.vertices.T)
    start = columns[:, mesh.faces[:, 0]]
    (ax, ay, az), (bx, by, bz) = columns[:, mesh.faces[:, 1]] - start, columns[:, mesh.faces[:, 2]] - start
    return np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2)


def measure_distance_to_surface(points: Points, mesh: TriangleMesh, samples: int) -> Float64[np.ndarray, " n"]:
    """Measure the distance of each point to the triangles of the samples nearest to it [m]."""
    return _SampledSurface(mesh, samples).measure_distance(points)


def find_largest_distance_to_surface(points: Points, mesh: TriangleMesh, samples: int) -> float:
    """Find the largest of `measure_distance_to_surface` [m].

    The distance to the nearest sample bounds each, so that only points with large bounds are measured.
    """
    surface = _SampledSurface(mesh, samples)
    bounds, _ = surface.tree.query(points)
    order, largest = np.argsort(-bounds, kind="stable"), 0.0
    for start in range(0, len(points), _BATCH):
        batch = order[start : start + _BATCH]
        if bounds[batch[0]] < largest - _ROUNDING_M:
            break
        largest = max(largest, float(surface.measure_distance(points[batch]).max()))
    return largest


class _SampledSurface:
    """Samples of a mesh, with the triangle of each."""

    def __init__(self, mesh: TriangleMesh, samples: int) -> None:
        points, self._triangle = sample_surface(mesh, samples)
        self._mesh, self.tree = mesh, cKDTree(points)

    def measure_distance(self, points: Points) -> Float64[np.ndarray, " n"]:
        _, near = self.tree.query(points, k=min(_NEAREST, self.tree.n))
        candidates = self._triangle[near.reshape(len(points), -1)]
        repeated = np.repeat(points, candidates.shape[1], axis=0)
        closest = closest_point(self._mesh.vertices[self._mesh.faces[candidates.ravel()]], repeated)
        distances = np.linalg.norm(closest - repeated, axis=1).reshape(candidates.shape)
        return distances.min(axis=1)
