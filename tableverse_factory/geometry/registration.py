"""Registration of a mesh to observed points: heading search, then refinement (paper section 3.1)."""

import numpy as np
from scipy.spatial import cKDTree

from schemas.geometry import Points, TriangleMesh

SAMPLES = 3000


def surface_samples(mesh: TriangleMesh, count: int, seed: int = 0) -> Points:
    """Points spread evenly over the surface, the same on every call. Shape (count, 3) [m]."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(seed)
    steps = (np.arange(count) + 0.5) / count * area.sum()
    face = np.searchsorted(np.cumsum(area), steps).clip(max=len(area) - 1)
    u, v = rng.random((2, count))
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u)[:, None], np.where(fold, 1.0 - v, v)[:, None]
    samples: Points = a[face] + u * (b - a)[face] + v * (c - a)[face]
    return samples


def median_distance(points: Points, mesh: TriangleMesh) -> float:
    """Median distance from the points to the surface, by dense samples of it [m]."""
    distance, _ = cKDTree(surface_samples(mesh, 4 * SAMPLES)).query(points[:: max(1, len(points) // SAMPLES)])
    return float(np.median(distance))
