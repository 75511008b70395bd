"""Solids as sampled fields: a regular grid, marching cubes and simplification, both always closed."""

from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float64
from skimage.measure import marching_cubes

from schemas.geometry import Frozen, Points, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.open3d_import import o3d
from tableverse_factory.geometry.mesh.repair import mesh_to_solid, solid_to_mesh

Field = Float64[np.ndarray, "nx ny nz"]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelGrid(Frozen):
    """Positions of the samples of a field: `shape` of them, `cell` apart, (0, 0, 0) at `origin` [m]."""

    origin: Vector3
    cell: float
    shape: tuple[int, int, int]

    def points(self) -> Points:
        """All sample positions, last axis fastest. Shape (nx * ny * nz, 3) [m]."""
        return np.stack(np.meshgrid(*self.axes(), indexing="ij"), axis=-1).reshape(-1, 3)

    def axes(self) -> tuple[Float64[np.ndarray, " k"], ...]:
        """Coordinates of the samples along each axis [m]."""
        return tuple(self.origin[k] + self.cell * np.arange(self.shape[k]) for k in range(3))


def make_grid(low: Vector3, high: Vector3, cell: float) -> VoxelGrid:
    """Make the grid with this spacing that covers a box with half a cell to spare on every side."""
    counts = np.maximum(np.ceil((high - low) / cell).astype(int) + 1, 2)
    spare = counts * cell - (high - low)
    shape = (int(counts[0]), int(counts[1]), int(counts[2]))
    return VoxelGrid(low - spare / 2 + cell / 2, cell, shape)


def extract_surface(field: Field, grid: VoxelGrid) -> TriangleMesh:
    """Extract the closed surface around the positive samples, where the field is zero.

    The field is a signed distance near its zero (positive inside, [m]) and is clamped to two cells; a border of
    outside samples closes the surface at the grid's edge.
    """
    reach = 2 * grid.cell
    clamped = np.clip(field, -reach, reach)
    # A sample exactly on the surface would give triangles without area.
    clamped = np.where(np.abs(clamped) < 1e-3 * grid.cell, -1e-3 * grid.cell, clamped)
    if not (clamped > 0.0).any():
        raise GeometryError("the field is positive nowhere: there is no solid")
    padded = np.pad(clamped, 1, constant_values=-reach)
    vertices, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="ascent")
    placed = np.asarray(vertices, dtype=np.float64) * grid.cell + (grid.origin - grid.cell)
    return TriangleMesh(placed, np.asarray(faces, dtype=np.int32))


def to_manifold(mesh: TriangleMesh) -> manifold3d.Manifold:
    """Convert a mesh to a solid; a `GeometryError` if it is not the closed, oriented surface of one."""
    solid = mesh_to_solid(mesh)
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        raise GeometryError(f"the mesh bounds no solid: {solid.status().name}")
    return solid


def from_manifold(solid: manifold3d.Manifold) -> TriangleMesh:
    """Convert a solid, which must not be empty, to its closed surface."""
    if solid.is_empty():
        raise GeometryError("the solid is empty")
    return solid_to_mesh(solid)


def find_largest_part(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    """Find the connected part with the greatest volume."""
    parts = solid.decompose()
    return max(parts, key=lambda part: float(part.volume())) if len(parts) > 1 else solid


def simplify_solid(solid: manifold3d.Manifold, max_faces: int, tolerance: float) -> manifold3d.Manifold:
    """Reduce faces, still closed: within `tolerance` [m] first, then by quadric error down to `max_faces`.

    Where the quadric decimation would break the surface, the tolerance grows instead, by half at a time.
    """
    result = solid.simplify(tolerance)
    if result.num_tri() <= max_faces:
        return result
    mesh = solid_to_mesh(result)
    vertices, faces = o3d.utility.Vector3dVector(mesh.vertices.copy()), o3d.utility.Vector3iVector(mesh.faces.copy())
    # Quadric error decimation (Garland and Heckbert, SIGGRAPH 1997).
    raw = o3d.geometry.TriangleMesh(vertices, faces).simplify_quadric_decimation(max_faces)
    decimated = TriangleMesh(np.asarray(raw.vertices).copy(), np.asarray(raw.triangles, dtype=np.int32).copy())
    try:
        return to_manifold(decimated)
    except GeometryError:
        for _ in range(12):
            tolerance *= 1.5
            result = result.simplify(tolerance)
            if result.num_tri() <= max_faces:
                break
        return result
