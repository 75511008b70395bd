"""Centre of mass and inertia of a body, from its mesh and its mass, robust for open meshes."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Faces, Frozen, Matrix3, TriangleMesh, Vector3
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.hulls import make_hull_mesh, unite_hulls
from tableverse_factory.geometry.mesh.mass_integrals import integrate_volume
from tableverse_factory.geometry.mesh.repair import solid_to_mesh
from tableverse_factory.geometry.mesh.shells import is_one_shell, unite_shells

MIN_GYRATION_M = 5e-4  # least radius about any axis: below it, single contacts spin a body too fast for a 2 ms step
REMEMBERED_BYTES = 4 * 1024  # one flag for each mesh of some scenes
MIN_COMPACTNESS = 1e-3  # least volume over that of the box for which a closed mesh counts as a solid


@dataclass(frozen=True, slots=True, eq=False)
class MassProperties(Frozen):
    """Mass properties of a body of uniform density, in the mesh's own frame: centre [m], inertia about it [kg m²].

    `source` is `mesh`, or `pieces` or `hull` where the mesh is not a closed volume.
    """

    mass_kg: float
    volume_m3: float
    center: Vector3
    inertia: Matrix3
    source: str

    def with_mass(self, mass_kg: float) -> "MassProperties":
        """Set the mass by the density."""
        return replace(self, mass_kg=mass_kg, inertia=self.inertia * (mass_kg / self.mass_kg))


@dataclass(frozen=True, slots=True, eq=False)
class VolumeMoments(Frozen):
    """Centre [m] and second moments about it [m⁵] of the volume that a mass is spread over, in the mesh's own frame."""

    volume_m3: float
    center: Vector3
    second: Matrix3
    source: str

    def of_mass(self, mass_kg: float) -> MassProperties:
        """Compute the mass properties for a mass."""
        inertia = _compute_inertia(self.second * (mass_kg / self.volume_m3), mass_kg)
        return MassProperties(mass_kg, self.volume_m3, self.center, inertia, self.source)


def compute_mass_properties(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], mass_kg: float) -> MassProperties:
    """Compute mass properties of the scaled mesh, in the way of `compute_volume_moments`."""
    return compute_volume_moments(mesh, hulls).of_mass(mass_kg)


def compute_volume_moments(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...]) -> VolumeMoments:
    """Compute moments of the scaled mesh; of its pieces' union, then of its hull, where it is not a closed volume.

    Volume that several shells enclose counts once (`unite_shells`).
    """
    if is_closed(mesh):
        found = _integrate_closed(mesh if is_one_shell(mesh) else unite_shells(mesh), "mesh")
        if found is not None:
            return found
    union = solid_to_mesh(unite_hulls(hulls))
    found = _integrate_closed(union, "pieces") if len(union.faces) else None
    if found is not None:
        return found
    hull = make_hull_mesh(np.concatenate([hull.vertices for hull in hulls]))
    return VolumeMoments(*integrate_volume(hull), "hull")


def is_closed(mesh: TriangleMesh) -> bool:
    """Whether every directed edge meets its reverse exactly once: a closed, consistently oriented surface."""
    return _is_closed(mesh.faces)


@memoize_by_content(REMEMBERED_BYTES)
def _is_closed(faces: Faces) -> bool:
    """Cached by the triangles alone: three stages need it for the same ones."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    n = int(faces.max(initial=0)) + 1
    forward = np.sort(edges[:, 0] * n + edges[:, 1])
    backward = np.sort(edges[:, 1] * n + edges[:, 0])
    return bool((np.diff(forward) > 0).all() and np.array_equal(forward, backward))


def _integrate_closed(mesh: TriangleMesh, source: str) -> VolumeMoments | None:
    volume, center, moments = integrate_volume(mesh)
    low, high = aabb(mesh.vertices)
    if volume <= MIN_COMPACTNESS * float(np.prod(high - low)) or not ((low <= center) & (center <= high)).all():
        return None
    return VolumeMoments(volume, center, moments, source) if np.linalg.eigvalsh(moments)[0] > 0.0 else None


def _compute_inertia(moments: Matrix3, mass_kg: float) -> Matrix3:
    """Compute the inertia from second moments of mass, at least that of the least radius of gyration.

    Adding the same to all three second moments keeps the triangle inequality that MuJoCo checks.
    """
    inertia: Matrix3 = np.trace(moments) * np.eye(3) - moments
    lacking = mass_kg * MIN_GYRATION_M**2 - float(np.linalg.eigvalsh(inertia)[0])
    return inertia + max(lacking, 0.0) * np.eye(3)
