"""Centre of mass and inertia of a body, from its mesh and its mass, robust for open meshes."""

from dataclasses import dataclass, replace

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull

from schemas.geometry import Faces, Frozen, Matrix3, TriangleMesh, Vector3
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.hulls import outward_faces
from tableverse_factory.geometry.mesh.mass_integrals import volume_integrals
from tableverse_factory.geometry.mesh.shells import bounded_by_shells, is_one_shell

MIN_GYRATION_M = 5e-4
"""Least radius of gyration about any axis: below it, single contacts spin a body faster than a 2 ms step resolves."""

REMEMBERED_BYTES = 4 * 1024
"""Yes or no for the meshes of some scenes."""

MIN_COMPACTNESS = 1e-3
"""Least volume over the volume of the box at which the volume of a closed mesh is believed."""


@dataclass(frozen=True, slots=True, eq=False)
class MassProperties(Frozen):
    """Of a body of uniform density, in the mesh's own frame.

    Attributes:
        volume_m3: Volume that the mass was spread over.
        center: Centre of mass [m].
        inertia: About the centre of mass [kg m²]. Shape (3, 3).
        source: `mesh`, or `pieces` or `hull` where the mesh is not a closed volume.
    """

    mass_kg: float
    volume_m3: float
    center: Vector3
    inertia: Matrix3
    source: str

    def with_mass(self, mass_kg: float) -> "MassProperties":
        """The same shape of another density."""
        return replace(self, mass_kg=mass_kg, inertia=self.inertia * (mass_kg / self.mass_kg))


@dataclass(frozen=True, slots=True, eq=False)
class VolumeMoments(Frozen):
    """Of the volume that a body's mass is spread over, in the mesh's own frame.

    Attributes:
        center: Its centre [m].
        second: Second moments about the centre [m⁵]. Shape (3, 3).
        source: As in `MassProperties`.
    """

    volume_m3: float
    center: Vector3
    second: Matrix3
    source: str

    def of_mass(self, mass_kg: float) -> MassProperties:
        """The body of this mass."""
        inertia = _inertia(self.second * (mass_kg / self.volume_m3), mass_kg)
        return MassProperties(mass_kg, self.volume_m3, self.center, inertia, self.source)


def mass_properties(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], mass_kg: float) -> MassProperties:
    """Mass properties of the scaled mesh; of its pieces' union, then of its hull, where it is not a closed volume."""
    return volume_moments(mesh, hulls).of_mass(mass_kg)


def volume_moments(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...]) -> VolumeMoments:
    """Moments of the scaled mesh; of its pieces' union, then of its hull, where it is not a closed volume.

    What several shells of a mesh enclose counts once (`bounded_by_shells`).
    """
    if is_closed(mesh):
        found = _of_closed(mesh if is_one_shell(mesh) else bounded_by_shells(mesh), "mesh")
        if found is not None:
            return found
    union = _union(hulls)
    found = _of_closed(union, "pieces") if len(union.faces) else None
    return found or _of_hull(np.concatenate([hull.vertices for hull in hulls]))


def is_closed(mesh: TriangleMesh) -> bool:
    """Whether every directed edge meets its reverse exactly once: a closed, consistently oriented surface."""
    return _is_closed(mesh.faces)


@memoize_by_content(REMEMBERED_BYTES)
def _is_closed(faces: Faces) -> bool:
    """Asked of the same triangles by three stages, wherever their corners are."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    n = int(faces.max(initial=0)) + 1
    forward = np.sort(edges[:, 0] * n + edges[:, 1])
    backward = np.sort(edges[:, 1] * n + edges[:, 0])
    return bool((np.diff(forward) > 0).all() and np.array_equal(forward, backward))


def _of_closed(mesh: TriangleMesh, source: str) -> VolumeMoments | None:
    volume, center, moments = volume_integrals(mesh)
    low, high = aabb(mesh.vertices)
    if volume <= MIN_COMPACTNESS * float(np.prod(high - low)) or not ((low <= center) & (center <= high)).all():
        return None
    if np.linalg.eigvalsh(moments)[0] <= 0.0:
        return None
    return VolumeMoments(volume, center, moments, source)


def _inertia(moments: Matrix3, mass_kg: float) -> Matrix3:
    """Inertia from second moments of mass, with the least radius of gyration added where the body is too small.

    Adding the same to all three second moments keeps the triangle inequality that MuJoCo checks.
    """
    inertia: Matrix3 = np.trace(moments) * np.eye(3) - moments
    lacking = mass_kg * MIN_GYRATION_M**2 - float(np.linalg.eigvalsh(inertia)[0])
    return inertia + max(lacking, 0.0) * np.eye(3)


def _union(hulls: tuple[TriangleMesh, ...]) -> TriangleMesh:
    solids = [manifold3d.Manifold.hull_points(np.ascontiguousarray(hull.vertices, dtype=np.float64)) for hull in hulls]
    merged = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    return TriangleMesh(
        np.array(merged.vert_properties[:, :3], dtype=np.float64), np.array(merged.tri_verts, dtype=np.int32)
    )


def _of_hull(points: np.ndarray) -> VolumeMoments:
    hull = ConvexHull(points)
    corners, faces = outward_faces(hull)
    volume, center, moments = volume_integrals(TriangleMesh(corners, faces))
    return VolumeMoments(volume, center, moments, "hull")
