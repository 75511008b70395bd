"""An object's shape for the simulator, without mass and pose: settle, curate and export share it."""

from dataclasses import dataclass, replace

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.physics.mjcf.inertia import VolumeMoments, compute_volume_moments
from tableverse_factory.physics.mjcf.obj_assets import prepare_hulls, scale_and_quantize

REMEMBERED_BYTES = 64 * 1024 * 1024  # the objects of many scenes: stages in one process share the results


@dataclass(frozen=True, slots=True, eq=False)
class BodyShape(Frozen):
    """Mesh and convex pieces [m], in the mesh's own frame, rounded as written; no piece is too thin to simulate."""

    mesh: TriangleMesh
    hulls: tuple[TriangleMesh, ...]
    moments: VolumeMoments


def make_body_shape(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], scale: float) -> BodyShape:
    """Make the shape of a mesh and its pieces at `scale`; GeometryError if no piece is thick enough to simulate."""
    pieces, moments = _make_collision_shape(replace(mesh, vertex_colors=None, texture=None), hulls, scale)
    return BodyShape(scale_and_quantize(mesh, scale), pieces, moments)


@memoize_by_content(REMEMBERED_BYTES)
def _make_collision_shape(
    mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], scale: float
) -> tuple[tuple[TriangleMesh, ...], VolumeMoments]:
    """Compute the pieces and the moments, which take time; the large mesh and its pictures are not cached."""
    pieces = prepare_hulls(hulls, scale)
    return pieces, compute_volume_moments(scale_and_quantize(mesh, scale), pieces)
