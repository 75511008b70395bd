"""Fit of a surface of revolution, with handles."""

from dataclasses import dataclass

from manifold3d import Manifold

from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.geometry.math.transforms import invert_pose, matrix_from_pose, transform_points
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold, simplify_solid
from tableverse_factory.stages.place.completion.handle import add_handles
from tableverse_factory.stages.place.completion.profile_curve import fit_profile
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, cast_on_mesh, compute_misfit
from tableverse_factory.stages.place.completion.revolution_axis import propose_axes
from tableverse_factory.stages.place.view.object_view import ObjectView

MAX_SPREAD_M = 0.0025
"""Most spread of the distances of a slice's points from an axis [m]."""
SEGMENTS = 40
MAX_FACES = 3200
TOLERANCE_M = 0.00005
AXIS_FREEDOM_M = (0.0, 1e-4, 3e-4)
"""Costs of an upright, a lying and a free axis [m]: of shapes that fit a ball, the upright one wins."""
HANDLE_FREEDOM = 0.2
"""Cost of handles as a share of the misfit that they remove: they complete a good body, not a wrong one."""
WORTH_HANDLES_M = 0.004
"""Misfit from which the body is wrong and the rest is no handle [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Revolution(Frozen):
    """A solid of revolution in the table frame.

    Attributes:
        mesh: Mesh in its own frame, z along the axis, the origin at the centre of its box; with handles.
        pose: Its own frame in the table frame.
        hollow: Whether it has a cavity that opens upward.
        cost: Misfit, plus costs of a free axis and of handles [m].
    """

    mesh: TriangleMesh
    pose: Pose
    hollow: bool
    cost: float


def fit_revolution(view: ObjectView, rays: RaySample) -> Revolution | None:
    """Fit the best over the candidate axes; None where none gives a solid."""
    found = [
        fit_about_axis(view, rays, axis, freedom)
        for (axis, spread), freedom in zip(propose_axes(view), AXIS_FREEDOM_M, strict=False)
        if spread < MAX_SPREAD_M
    ]
    return min((fit for fit in found if fit is not None), key=lambda fit: fit.cost, default=None)


def fit_about_axis(view: ObjectView, rays: RaySample, axis: Pose, freedom: float = 0.0) -> Revolution | None:
    """Fit the solid about one axis (a frame with z along it); None where free space leaves nothing of it."""
    sections = fit_profile(view, axis)
    if sections is None:
        return None
    to_table = matrix_from_pose(axis)[:3]
    body = Manifold.revolve(sections[0], SEGMENTS).transform(to_table)
    if body.is_empty():
        return None
    bare = _to_frame(body, axis)
    cost = compute_misfit(rays, cast_on_mesh(rays, bare, axis))
    hollow = not sections[1].is_empty()
    if cost < WORTH_HANDLES_M:
        hole = Manifold.revolve(sections[1], SEGMENTS).transform(to_table) if hollow else None
        whole = simplify_solid(add_handles(view, body, hole), MAX_FACES, TOLERANCE_M)
        mesh = _to_frame(whole, axis)
        better = compute_misfit(rays, cast_on_mesh(rays, mesh, axis))
        if better < cost:
            bare, cost = mesh, better + HANDLE_FREEDOM * (cost - better)
    middle = (bare.vertices.min(axis=0) + bare.vertices.max(axis=0)) / 2
    pose = Pose(transform_points(axis, middle[None])[0], axis.quaternion_wxyz)
    return Revolution(TriangleMesh(bare.vertices - middle, bare.faces), pose, hollow, cost + freedom)


def _to_frame(solid: Manifold, axis: Pose) -> TriangleMesh:
    mesh = from_manifold(solid)
    return TriangleMesh(transform_points(invert_pose(axis), mesh.vertices), mesh.faces)
