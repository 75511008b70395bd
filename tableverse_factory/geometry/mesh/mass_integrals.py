"""Volume, centre and second moments of closed meshes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Matrix3, Points, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb

# Least share of its box that a mesh fills, and least volume of the box [m³], to enclose a volume
_MIN_FILLED_SHARE, _MIN_VOLUME_M3 = 1e-3, 1e-10

Rows = Float64[np.ndarray, "3 m"]


def integrate_volume(mesh: TriangleMesh) -> tuple[float, Vector3, Matrix3]:
    """Compute volume [m³], centre [m] and second moments about the centre [m⁵] of a closed mesh.

    Sums signed tetrahedra from the middle of the box: exact for polyhedra.
    """
    low, high = aabb(mesh.vertices)
    middle = (low + high) / 2
    corners, six_volumes = _make_tetrahedra(mesh.vertices - middle, mesh.faces)
    volume = float(six_volumes.sum() / 6)
    if volume == 0.0:
        return 0.0, middle, np.zeros((3, 3))
    total = corners[0] + corners[1] + corners[2]
    center = (total @ six_volumes) / (24 * volume)
    outer = sum((six_volumes * rows) @ rows.T for rows in (total, *corners))
    return volume, middle + center, outer / 120 - volume * np.outer(center, center)


def compute_signed_volume(mesh: TriangleMesh) -> float:
    """Compute the volume by the divergence theorem [m³]; negative for closed meshes that are inside out."""
    _, six_volumes = _make_tetrahedra(mesh.vertices, mesh.faces)
    return float(six_volumes.sum() / 6)


def encloses_volume(mesh: TriangleMesh) -> bool:
    """Whether the faces, seen from their middle, enclose a volume on the whole, as open scans do and sheets do not."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not areas.sum() > 0.0:
        return False
    middle = areas @ (a + b + c) / (3 * areas.sum())
    _, six_volumes = _make_tetrahedra(mesh.vertices - middle, mesh.faces)
    low, high = aabb(mesh.vertices)
    return bool(six_volumes.sum() / 6 > _MIN_FILLED_SHARE * max(float(np.prod(high - low)), _MIN_VOLUME_M3))


def compute_volumes_and_centers(
    meshes: Sequence[TriangleMesh], least_m3: float
) -> tuple[Float64[np.ndarray, " n"], Points]:
    """Compute volume [m³] and centre [m] of one or many small closed meshes at once.

    Those smaller than `least_m3` get this volume, and the mean of their corners as centre.
    """
    sizes = np.array([len(mesh.vertices) for mesh in meshes])
    counts = np.array([len(mesh.faces) for mesh in meshes])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    if not (sizes.all() and counts.all()):
        raise ValueError("a mesh without a corner or a face has no volume")
    starts = np.cumsum(sizes) - sizes
    middles: Points = np.add.reduceat(vertices, starts) / sizes[:, None]
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    corners, six_volumes = _make_tetrahedra(vertices - np.repeat(middles, sizes, axis=0), faces)
    first = np.cumsum(counts) - counts
    volumes: Float64[np.ndarray, " n"] = np.add.reduceat(six_volumes, first) / 6
    moments = np.add.reduceat((corners[0] + corners[1] + corners[2]) * six_volumes, first, axis=1).T / 24
    solid = volumes > least_m3
    middles[solid] += moments[solid] / volumes[solid, None]
    return np.maximum(volumes, least_m3), middles


def _make_tetrahedra(vertices: Points, faces: np.ndarray) -> tuple[tuple[Rows, Rows, Rows], Float64[np.ndarray, " m"]]:
    """Corners of each face, by coordinates, and six times the volume between it and the origin."""
    columns = np.ascontiguousarray(vertices.T)
    corners = columns[:, faces[:, 0]], columns[:, faces[:, 1]], columns[:, faces[:, 2]]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
    six_volumes = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    return corners, six_volumes
