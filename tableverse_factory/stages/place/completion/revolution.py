"""The surface of revolution that explains an object best."""

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
"""An axis from which the points of a slice lie at distances that spread more is no axis."""
SEGMENTS = 40
MAX_FACES = 3200
TOLERANCE_M = 0.00005
AXIS_FREEDOM_M = (0.0, 1e-4, 3e-4)
"""Prices of an upright, a lying and a free axis: of shapes that explain a ball, the upright one is taken."""
HANDLE_FREEDOM = 0.2
"""Price of handles by what they explain: they mend a nearly right body, they do not save a wrong one."""
WORTH_HANDLES_M = 0.004
"""Beyond this disagreement the body is wrong, and what it leaves unexplained is no handle."""


@dataclass(frozen=True, slots=True, eq=False)
class Revolution(Frozen):
    """A solid of revolution in the table frame.

    Attributes:
        mesh: In its own frame, z along the axis, the origin in the middle of its box; handles included.
        pose: Its own frame in the table frame.
        hollow: Whether it has a cavity that opens upward.
        price: Mean disagreement with the picture [m], and more for a free axis and for handles.
    """

    mesh: TriangleMesh
    pose: Pose
    hollow: bool
    price: float


def fit_revolution(view: ObjectView, rays: RaySample) -> Revolution | None:
    """The best over the candidate axes, or None where none gives a solid."""
    found = [
        fit_about_axis(view, rays, axis, freedom)
        for (axis, spread), freedom in zip(propose_axes(view), AXIS_FREEDOM_M, strict=False)
        if spread < MAX_SPREAD_M
    ]
    return min((fit for fit in found if fit is not None), key=lambda fit: fit.price, default=None)


def fit_about_axis(view: ObjectView, rays: RaySample, axis: Pose, freedom: float = 0.0) -> Revolution | None:
    """The solid about one axis (a frame with z along it); None where free space leaves nothing of it."""
    sections = fit_profile(view, axis)
    if sections is None:
        return None
    to_table = matrix_from_pose(axis)[:3]
    body = Manifold.revolve(sections[0], SEGMENTS).transform(to_table)
    if body.is_empty():
        return None
    bare = _to_frame(body, axis)
    price = compute_misfit(rays, cast_on_mesh(rays, bare, axis))
    hollow = not sections[1].is_empty()
    if price < WORTH_HANDLES_M:
        hole = Manifold.revolve(sections[1], SEGMENTS).transform(to_table) if hollow else None
        whole = simplify_solid(add_handles(view, body, hole), MAX_FACES, TOLERANCE_M)
        mesh = _to_frame(whole, axis)
        better = compute_misfit(rays, cast_on_mesh(rays, mesh, axis))
        if better < price:
            bare, price = mesh, better + HANDLE_FREEDOM * (price - better)
    middle = (bare.vertices.min(axis=0) + bare.vertices.max(axis=0)) / 2
    pose = Pose(transform_points(axis, middle[None])[0], axis.quaternion_wxyz)
    return Revolution(TriangleMesh(bare.vertices - middle, bare.faces), pose, hollow, price + freedom)


def _to_frame(solid: Manifold, axis: Pose) -> TriangleMesh:
    """A solid of the table frame in the frame of its axis."""
    mesh = from_manifold(solid)
    return TriangleMesh(transform_points(invert_pose(axis), mesh.vertices), mesh.faces)
