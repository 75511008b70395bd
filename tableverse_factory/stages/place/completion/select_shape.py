"""The mesh model `carved`: the simplest of five kinds of shape that explains the picture."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area
from tableverse_factory.stages.place.completion.box import SolidBox, build_box_mesh, fit_upright_box
from tableverse_factory.stages.place.completion.extend_to_floor import extend_to_floor
from tableverse_factory.stages.place.completion.leaning_box import fit_leaning_box
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, compute_mesh_misfit, sample_rays
from tableverse_factory.stages.place.completion.revolution import fit_revolution
from tableverse_factory.stages.place.completion.voxel_carving import CarvedSurface, carve_columns, carve_half_turn
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import ObjectView

BOX_DISCOUNT = 0.4
BOX_DISCOUNT_M = 0.0008  # most forgiven to boxes [m]: flat faces carry all error of the depth, free shapes follow it
HOLLOW_BONUS_M = 0.0012  # of a cavity seen [m]: a thin wall in noise must not lose to a solid that follows the noise
UNAVOIDABLE_M = 0.0003  # misfit of even the true shape [m]: a kind whose freedom alone costs more is not tried

RAGGED_M = 0.002  # cost of surface area beyond a smooth solid's, per area of the hull [m]
SIMPLER_M = 3e-4  # most by which simplification makes a misfit smaller [m]; 0.13 mm is the most measured
SMOOTH = 1.03  # surface over that of the hull: 0.98 to 1.03 for fully visible half-turned solids, 1.15 for torn ones

Shape = tuple[TriangleMesh, Pose, float]  # mesh, pose, and cost: disagreement with the picture [m]


def complete_by_carving(scene: PerceivedObjects, view: ObjectView) -> Completion:  # noqa: ARG001
    """Fit boxes, a surface of revolution, a half-turn symmetric solid and columns, and select the best."""
    rays = sample_rays(view)
    best: tuple[float, str, TriangleMesh, Pose] | None = None
    reasons: list[str] = []
    for method, freedom, make in KINDS:
        if best is not None and best[0] < freedom + UNAVOIDABLE_M:
            continue
        try:
            shape = make(view, rays, np.inf if best is None else best[0] - freedom)
        except GeometryError as error:
            reasons.append(str(error))
            continue
        if shape is not None and (best is None or shape[2] + freedom < best[0]):
            best = (shape[2] + freedom, method, shape[0], shape[1])
    if best is None:
        raise GeometryError("; ".join(dict.fromkeys(reasons)) or "no shape explains the points")
    _, best_method, mesh, pose = best
    if view.support.leaning:
        mesh = extend_to_floor(mesh, pose, view.points, view.support_z)
    return Completion(mesh, pose, best_method)


def _discount_box(box: SolidBox) -> Shape:
    return build_box_mesh(box), box.pose, box.misfit - min(BOX_DISCOUNT * box.misfit, BOX_DISCOUNT_M)


def _make_revolution(view: ObjectView, rays: RaySample, limit: float) -> Shape | None:  # noqa: ARG001
    if (fit := fit_revolution(view, rays)) is None:
        return None
    mesh, pose, cost, hollow = fit
    return mesh, pose, cost - (HOLLOW_BONUS_M if hollow else 0.0)


def _make_half_turn(view: ObjectView, rays: RaySample, limit: float) -> Shape | None:
    if (shape := _simplify_carved(carve_half_turn(view), rays, limit)) is None:
        return None
    mesh, pose, misfit = shape
    try:
        hull = float(ConvexHull(mesh.vertices).area)
    except QhullError as error:
        raise GeometryError("what free space leaves is flat") from error
    raggedness = RAGGED_M * max(compute_surface_area(mesh) / hull - SMOOTH, 0.0)  # torn by free space at an occluder
    return mesh, pose, misfit + raggedness


def _make_columns(view: ObjectView, rays: RaySample, limit: float) -> Shape | None:
    return _simplify_carved(carve_columns(view), rays, limit)


def _simplify_carved(carved: CarvedSurface, rays: RaySample, limit: float) -> Shape | None:
    """Simplify a carved surface, which costs the most of it, unless as it is it cannot come below `limit` [m]."""
    if compute_mesh_misfit(rays, carved.mesh, carved.pose) >= limit + SIMPLER_M:
        return None
    mesh = carved.simplify()
    return mesh, carved.pose, compute_mesh_misfit(rays, mesh, carved.pose)


# Name in the dataset, cost of its freedom to follow the picture [m] and best fit of each kind, in the order of trial:
# the fewer freedoms a kind has, the earlier and the cheaper. A fit may be None that cannot cost less than a limit [m].
KINDS: tuple[tuple[str, float, Callable[[ObjectView, RaySample, float], Shape | None]], ...] = (
    ("carved/box", 0.0, lambda view, rays, _: _discount_box(fit_upright_box(view, rays))),
    ("carved/revolution", 1e-4, _make_revolution),
    ("carved/leaning_box", 3e-4, lambda view, rays, _: _discount_box(fit_leaning_box(view, rays))),
    ("carved/half_turn", 5e-4, _make_half_turn),
    ("carved/columns", 2.0e-3, _make_columns),
)
