"""An object's shape as the simulator has it, without its mass and its place: settle, curate and export share it."""

from dataclasses import dataclass

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.physics.assets import scaled, usable_hulls
from tableverse_factory.physics.inertia import VolumeMoments, volume_moments
from tableverse_factory.recent import recent

REMEMBERED = 32
"""The objects of a few scenes: what one stage has measured, the next finds again where both run in one process."""


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


@recent(REMEMBERED)
def shape_of(mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], scale: float) -> Shape:
    """The mesh and its pieces at `scale`.

    Raises:
        GeometryError: if no piece is thick enough to simulate.
    """
    metric, pieces = scaled(mesh, scale), usable_hulls(hulls, scale)
    return Shape(metric, pieces, volume_moments(metric, pieces))
