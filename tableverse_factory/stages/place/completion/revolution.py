"""Fit of a surface of revolution, with handles."""

from manifold3d import Manifold

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.geometry.math.transforms import invert_pose, matrix_from_pose, transform_points
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold, simplify_solid
from tableverse_factory.stages.place.completion.handle import add_handles
from tableverse_factory.stages.place.completion.profile_curve import fit_profile
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, compute_mesh_misfit
from tableverse_factory.stages.place.completion.revolution_axis import propose_axes
from tableverse_factory.stages.place.view.object_view import ObjectView

MAX_SPREAD_M = 0.0025  # most spread of the distances of a slice's points from an axis [m]
SEGMENTS = 40
MAX_FACES = 3200
TOLERANCE_M = 0.00005
AXIS_FREEDOM_M = (0.0, 1e-4, 3e-4)  # costs of an upright, a lying and a free axis: of fits to a ball the upright wins
HANDLE_FREEDOM = 0.2  # cost of handles, as a share of the misfit that they remove: they complete only a good body
WORTH_HANDLES_M = 0.004  # misfit from which the body is wrong and the rest is no handle [m]

# Mesh with handles, z along the axis, the origin at the centre of its box; its pose in the table frame; misfit, plus
# costs of a free axis and of handles [m]; and whether a cavity opens upward.
Revolution = tuple[TriangleMesh, Pose, float, bool]


def fit_revolution(view: ObjectView, rays: RaySample) -> Revolution | None:
    """Fit the best over the candidate axes; None where none gives a solid."""
    found = [
        _fit_about_axis(view, rays, axis, freedom)
        for (axis, spread), freedom in zip(propose_axes(view), AXIS_FREEDOM_M, strict=False)
        if spread < MAX_SPREAD_M
    ]
    return min((fit for fit in found if fit is not None), key=lambda fit: fit[2], default=None)


def _fit_about_axis(view: ObjectView, rays: RaySample, axis: Pose, freedom: float) -> Revolution | None:
    sections = fit_profile(view, axis)
    if sections is None:
        return None
    to_table = matrix_from_pose(axis)[:3]
    body = Manifold.revolve(sections[0], SEGMENTS).transform(to_table)
    if body.is_empty():
        return None
    bare = _to_frame(body, axis)
    cost = compute_mesh_misfit(rays, bare, axis)
    hollow = not sections[1].is_empty()
    if cost < WORTH_HANDLES_M:
        hole = Manifold.revolve(sections[1], SEGMENTS).transform(to_table) if hollow else None
        whole = simplify_solid(add_handles(view, body, hole), MAX_FACES, TOLERANCE_M)
        mesh = _to_frame(whole, axis)
        better = compute_mesh_misfit(rays, mesh, axis)
        if better < cost:
            bare, cost = mesh, better + HANDLE_FREEDOM * (cost - better)
    middle = (bare.vertices.min(axis=0) + bare.vertices.max(axis=0)) / 2
    pose = Pose(transform_points(axis, middle[None])[0], axis.quaternion_wxyz)
    return TriangleMesh(bare.vertices - middle, bare.faces), pose, cost + freedom, hollow


def _to_frame(solid: Manifold, axis: Pose) -> TriangleMesh:
    mesh = from_manifold(solid)
    return TriangleMesh(transform_points(invert_pose(axis), mesh.vertices), mesh.faces)
