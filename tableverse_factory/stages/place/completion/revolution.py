"""Fit of a surface of revolution, with handles."""

from manifold3d import Manifold

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.stages.place.completion.handle import join_handles
from tableverse_factory.stages.place.completion.profile_curve import fit_profile
from tableverse_factory.stages.place.completion.ray_misfit import RaySample
from tableverse_factory.stages.place.completion.revolution_axis import propose_axes
from tableverse_factory.stages.place.view.object_view import ObjectView

MAX_SPREAD_M = 0.0025  # most spread of the distances of a slice's points from an axis [m]
SEGMENTS = 40
AXIS_FREEDOM_M = (0.0, 1e-4, 3e-4)  # costs of an upright, a lying and a free axis: of fits to a ball the upright wins

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
    body = Manifold.revolve(sections[0], SEGMENTS)
    if body.is_empty():
        return None
    hollow = not sections[1].is_empty()
    hole = Manifold.revolve(sections[1], SEGMENTS) if hollow else None
    mesh, pose, cost = join_handles(view, rays, body, hole, axis)
    return mesh, pose, cost + freedom, hollow
