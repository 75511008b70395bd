"""Voxel remeshing of broken triangles: voxels around them, and a new surface around those."""

import numpy as np
from scipy.ndimage import label
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area, sample_surface

RESOLUTION = 64  # voxels along the longest side
SEALED = 0.9  # space within this many voxels of the triangles is blocked: more than half a voxel's diagonal
SKIN = 0.25  # the new surface lies this many voxels outside the triangles
SAMPLES_PER_VOXEL_FACE = 6.0
MAX_SAMPLES = 1_000_000
SAMPLES_PER_VOXEL = 4.0  # along each axis; of samples nearer to one another, in folded or doubled surfaces, one is kept
MIN_AREA_SHARE = 1e-9  # share of the square of the extent


def remesh(mesh: TriangleMesh) -> TriangleMesh:
    """Make a closed surface around the triangles and around the space that they shut off from outside.

    Closed but broken surfaces become solids; open sheets become plates, their cavities kept. Error: `SKIN` voxels.
    """
    low, high = aabb(mesh.vertices)
    extent = float((high - low).max())
    area = compute_surface_area(mesh)
    if not area > MIN_AREA_SHARE * extent**2:
        raise GeometryError(f"{len(mesh.faces)} triangles of {area:g} m² in all, {extent:g} m apart, are no surface")
    voxel = extent / RESOLUTION
    count = int(np.clip(SAMPLES_PER_VOXEL_FACE * area / voxel**2, 1000, MAX_SAMPLES))
    points = np.concatenate([sample_surface(mesh, count)[0], mesh.vertices[np.unique(mesh.faces)][:MAX_SAMPLES]])
    points = _thin_points(points, voxel / SAMPLES_PER_VOXEL)
    origin = low - 3.0 * voxel
    shape = np.ceil((high - origin) / voxel).astype(int) + 4
    centers = origin + voxel * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    tree = cKDTree(points, balanced_tree=False)  # balancing is extremely slow where many coordinates are equal
    reach = 3.0 * voxel
    distance, _ = tree.query(centers.reshape(-1, 3), distance_upper_bound=reach)
    distance = np.minimum(distance, reach).reshape(shape)
    regions, _ = label(distance > SEALED * voxel)
    outside = regions == regions[0, 0, 0]
    level = np.where(outside, distance - SEALED * voxel, np.minimum(distance - SEALED * voxel, -0.1 * voxel))
    vertices, faces, _, _ = marching_cubes(level, 0.0)
    vertices = origin + voxel * vertices.astype(np.float64)
    away, nearest = tree.query(vertices)
    direction = (vertices - points[nearest]) / np.maximum(away, 1e-12 * voxel)[:, None]
    return TriangleMesh(points[nearest] + SKIN * voxel * direction, faces.astype(np.int32))


def _thin_points(points: Points, cell: float) -> Points:
    """Keep the first point in each cell of a grid, in their order."""
    place = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    shape = place.max(axis=0) + 1
    first = np.unique((place[:, 0] * shape[1] + place[:, 1]) * shape[2] + place[:, 2], return_index=True)[1]
    return points[np.sort(first)]
