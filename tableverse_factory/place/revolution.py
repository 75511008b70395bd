"""The surface of revolution that explains an object best."""

from dataclasses import dataclass

import numpy as np
from manifold3d import Manifold

from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.geometry.transforms import transform_points
from tableverse_factory.geometry.volume import from_manifold
from tableverse_factory.place.axis import axis_candidates
from tableverse_factory.place.explain import Rays, mesh_hits, misfit
from tableverse_factory.place.section import half_section
from tableverse_factory.place.sighting import Sighting

MAX_SPREAD_M = 0.004
"""An axis from which the points of a slice lie at distances that spread more is no axis."""
SEGMENTS = 40


@dataclass(frozen=True, slots=True, eq=False)
class Revolution(Frozen):
    """A solid of revolution in the table frame.

    Attributes:
        mesh: In its own frame, z along the axis, the origin in the middle of its box.
        pose: Its own frame in the table frame.
        hollow: Whether it has a cavity that opens upward.
        misfit: Mean disagreement with the picture [m].
    """

    mesh: TriangleMesh
    pose: Pose
    hollow: bool
    misfit: float


def best_revolution(sighting: Sighting, rays: Rays) -> Revolution | None:
    """The best over the candidate axes, or None where none gives a solid."""
    found = [
        revolution_about(sighting, rays, axis) for axis, spread in axis_candidates(sighting) if spread < MAX_SPREAD_M
    ]
    return min((fit for fit in found if fit is not None), key=lambda fit: fit.misfit, default=None)


def revolution_about(sighting: Sighting, rays: Rays, axis: Pose) -> Revolution | None:
    """The solid about one axis (a frame with z along it); None where free space leaves nothing of it."""
    section = half_section(sighting, axis)
    if section is None:
        return None
    solid = Manifold.revolve(section[0], SEGMENTS)
    if solid.is_empty():
        return None
    mesh = from_manifold(solid)
    middle = np.array([0.0, 0.0, (mesh.vertices[:, 2].min() + mesh.vertices[:, 2].max()) / 2])
    centred = TriangleMesh(mesh.vertices - middle, mesh.faces)
    pose = Pose(transform_points(axis, middle[None])[0], axis.quaternion_wxyz)
    return Revolution(centred, pose, section[1], misfit(rays, mesh_hits(rays, centred, pose)))
