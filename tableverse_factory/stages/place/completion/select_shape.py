"""The embedded default MeshModel: the simplest of five kinds of shape that explains the picture."""

from collections.abc import Callable
from dataclasses import dataclass

from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Frozen, Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area
from tableverse_factory.stages.place.completion.box import SolidBox, build_box_mesh, fit_upright_box
from tableverse_factory.stages.place.completion.extend_to_floor import extend_to_floor
from tableverse_factory.stages.place.completion.leaning_box import fit_leaning_box
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, cast_on_mesh, compute_misfit, sample_rays
from tableverse_factory.stages.place.completion.revolution import fit_revolution
from tableverse_factory.stages.place.completion.voxel_carving import carve_columns, carve_half_turn
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import ObjectView

BOX_DISCOUNT_M = 0.0008
"""Flat faces carry the whole error of a depth camera: a free shape follows it, a box must not pay for it."""
BOX_DISCOUNT = 0.4


HOLLOW_BONUS_M = 0.0012
"""A cavity seen is evidence of its own: a thin wall in noise must not lose against a solid that follows the noise."""
UNAVOIDABLE_M = 0.0003
"""Even the true shape disagrees by about this much: a kind whose freedom alone costs more is not tried."""

RAGGED_M = 0.002
"""Price of a surface as large as the hull's beyond a smooth one [m]."""
SMOOTH = 1.03
"""Half-turned solids that were seen whole have 0.98 to 1.03 of their hull's surface; what free space tore, 1.15."""

Shape = tuple[TriangleMesh, Pose, float]


@dataclass(frozen=True, slots=True, eq=False)
class _ShapeCandidate(Frozen):
    """A shape and its price: its disagreement with the picture, and more for each freedom it has [m]."""

    method: str
    price: float
    mesh: TriangleMesh
    pose: Pose


@dataclass(frozen=True, slots=True)
class _ShapeKind:
    """A kind of shape.

    Attributes:
        method: Its name in the records.
        freedom: What it pays for following the picture more freely than a simpler kind [m].
        make: Its best shape, and the disagreement with the picture [m]; None or an error where it has none.
    """

    method: str
    freedom: float
    make: Callable[[ObjectView, RaySample], Shape | None]


def complete_by_carving(scene: PerceivedObjects, view: ObjectView) -> Completion:  # noqa: ARG001
    """The best explanation among boxes, a surface of revolution, a half-turn symmetric solid and columns.

    Raises:
        GeometryError: if the points carry no solid.
    """
    rays = sample_rays(view)
    found: list[_ShapeCandidate] = []
    reasons: list[str] = []
    for kind in KINDS:
        if found and min(candidate.price for candidate in found) < kind.freedom + UNAVOIDABLE_M:
            continue
        try:
            shape = kind.make(view, rays)
        except GeometryError as error:
            reasons.append(str(error))
            continue
        if shape is not None:
            found.append(_ShapeCandidate(kind.method, shape[2] + kind.freedom, shape[0], shape[1]))
    if not found:
        raise GeometryError("; ".join(dict.fromkeys(reasons)) or "no shape explains the points")
    best = min(found, key=lambda candidate: candidate.price)
    if not view.support.leaning:
        return Completion(best.mesh, best.pose, best.method)
    stemmed = extend_to_floor(best.mesh, best.pose, view.points, view.support_z)
    return Completion(stemmed, best.pose, best.method)


def _make_upright_box(view: ObjectView, rays: RaySample) -> Shape:
    return _discount_box(fit_upright_box(view, rays))


def _make_leaning_box(view: ObjectView, rays: RaySample) -> Shape:
    return _discount_box(fit_leaning_box(view, rays))


def _discount_box(box: SolidBox) -> Shape:
    return build_box_mesh(box), box.pose, box.misfit - min(BOX_DISCOUNT * box.misfit, BOX_DISCOUNT_M)


def _make_revolution(view: ObjectView, rays: RaySample) -> Shape | None:
    fit = fit_revolution(view, rays)
    return None if fit is None else (fit.mesh, fit.pose, fit.price - (HOLLOW_BONUS_M if fit.hollow else 0.0))


def _make_half_turn(view: ObjectView, rays: RaySample) -> Shape:
    mesh, pose = carve_half_turn(view)
    return mesh, pose, compute_misfit(rays, cast_on_mesh(rays, mesh, pose)) + _measure_raggedness(mesh)


def _measure_raggedness(mesh: TriangleMesh) -> float:
    """What a solid pays for being torn by free space around something that stood before it [m]."""
    try:
        hull = float(ConvexHull(mesh.vertices).area)
    except QhullError as error:
        raise GeometryError("what free space leaves is flat") from error
    return RAGGED_M * max(compute_surface_area(mesh) / hull - SMOOTH, 0.0)


def _make_columns(view: ObjectView, rays: RaySample) -> Shape:
    mesh, pose = carve_columns(view)
    return mesh, pose, compute_misfit(rays, cast_on_mesh(rays, mesh, pose))


KINDS = (
    _ShapeKind("carved/box", 0.0, _make_upright_box),
    _ShapeKind("carved/revolution", 1e-4, _make_revolution),
    _ShapeKind("carved/leaning_box", 3e-4, _make_leaning_box),
    _ShapeKind("carved/half_turn", 5e-4, _make_half_turn),
    _ShapeKind("carved/columns", 2.0e-3, _make_columns),
)
"""In the order in which they are tried: the fewer freedoms a kind has, the earlier and the cheaper."""
