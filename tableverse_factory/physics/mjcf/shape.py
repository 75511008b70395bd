"""An object's shape as the simulator has it, without its mass and its place: settle, curate and export share it."""

from dataclasses import dataclass, replace

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.physics.mjcf.inertia import VolumeMoments, volume_moments
from tableverse_factory.physics.mjcf.obj_assets import scale_and_quantize, usable_hulls

REMEMBERED_BYTES = 64 * 1024 * 1024
"""The objects of many scenes: what one stage has measured, the next finds again where both run in one process."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape(Frozen):
    """In metres, in the mesh's own frame.

    Attributes:
        mesh: Scaled, rounded to what its file will say.
        hulls: Convex pieces, likewise, without those too thin to simulate.
        moments: Of the volume that the object's mass is spread over.
    """

    mesh: TriangleMesh
    hulls: tuple[TriangleMesh, ...]
    moments: VolumeMoments


def shape_of(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], scale: float) -> Shape:
    """The mesh and its pieces at `scale`.

    Raises:
        GeometryError: if no piece is thick enough to simulate.
    """
    pieces, moments = _solid(replace(mesh, vertex_colors=None, texture=None), hulls, scale)
    return Shape(scale_and_quantize(mesh, scale), pieces, moments)


@memoize_by_content(REMEMBERED_BYTES)
def _solid(
    mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], scale: float
) -> tuple[tuple[TriangleMesh, ...], VolumeMoments]:
    """What takes time: the pieces and the moments. The mesh itself and its pictures are large, and soon scaled."""
    pieces = usable_hulls(hulls, scale)
    return pieces, volume_moments(scale_and_quantize(mesh, scale), pieces)
