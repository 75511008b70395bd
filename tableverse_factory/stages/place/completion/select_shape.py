"""The mesh model `carved`: the simplest of several kinds of shape that explains the picture."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area
from tableverse_factory.geometry.registration.register import measure_median_distance
from tableverse_factory.stages.place.completion.box import SolidBox, build_box_mesh, fit_upright_box, round_edges
from tableverse_factory.stages.place.completion.extend_to_floor import extend_to_floor
from tableverse_factory.stages.place.completion.handle import join_handles
from tableverse_factory.stages.place.completion.inflation import inflate
from tableverse_factory.stages.place.completion.leaning_box import fit_leaning_box
from tableverse_factory.stages.place.completion.overlap import FREE
from tableverse_factory.stages.place.completion.ray_misfit import (
    RaySample,
    compute_mesh_misfit,
    compute_misfit,
    sample_rays,
)
from tableverse_factory.stages.place.completion.revolution import fit_revolution
from tableverse_factory.stages.place.completion.sheet import carve_sheet
from tableverse_factory.stages.place.completion.torn import hides_others, is_torn, measure_fullness
from tableverse_factory.stages.place.completion.turned import (
    TurnedFit,
    fit_lying,
    fit_solid,
    fit_standing,
    fit_vessel,
    shows_cavity,
)
from tableverse_factory.stages.place.completion.turned_profile import (
    TurnedProfile,
    build_turned_solid,
    intersect_turned,
)
from tableverse_factory.stages.place.completion.voxel_carving import CarvedSurface, carve_columns, carve_half_turn
from tableverse_factory.stages.place.completion.warp import warp_to_depth
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import ObjectView

BOX_DISCOUNT = 0.4
BOX_DISCOUNT_M = 0.0008  # most forgiven to boxes [m]: flat faces carry all error of the depth, free shapes follow it
HOLLOW_BONUS_M = 0.0012  # of a cavity seen [m]: a thin wall in noise must not lose to a solid that follows the noise
UNAVOIDABLE_M = 0.0003  # misfit of even the true shape [m]: a kind whose freedom alone costs more is not tried
ESTIMATED_UNAVOIDABLE_M = 7e-4  # the same where a model estimated the depth
FEW_NUMBERS_M = 1.2e-3  # the same of a turned shape of few numbers, less the bonus of its cavity

# Gain by rounded edges, from which they count and that is expected at most [m], the latter also as a share of a misfit:
# of six tins and food boxes 0.3 to 1.45 mm, of 49 boxes with sharp edges 0 to 0.17; what is round gains more
LEAST_GAIN_M, MOST_GAIN_M, MOST_GAIN_SHARE = 2.5e-4, 1.5e-3, 0.4
ROUNDED_M = 2e-4  # cost of rounded edges [m]: much rounded, a box is nearly a cylinder
RAGGED_M = 0.002  # cost of surface area beyond a smooth solid's, per area of the hull [m]
SIMPLER_M = 3e-4  # most by which simplification makes a misfit smaller [m]; 0.13 mm is the most measured
SMOOTH = 1.03  # surface over that of the hull: 0.98 to 1.03 for fully visible half-turned solids, 1.15 for torn ones

MOST_PLAIN_M = 0.003  # misfit of a plain shape, as of estimated depth [m]: of eleven that are right 0.8 to 2.9 mm
# By how much more than a free shape's that misfit may be [m]: at most, and by how much the free shape is dented, as the
# share of its hull that it leaves empty. What is smooth follows no errors
MOST_EXTRA_M, DENTED_M = 1e-3, 5e-3
# Median distance of the readings from a shape that is not what the picture shows, over that from the camera: 0.036 to
# 0.072 of five such in bare pictures, at most 0.031 of 380 others
MAX_RESIDUAL_SHARE = 0.035

Shape = tuple[TriangleMesh, Pose, float]  # mesh, pose, and cost: disagreement with the picture [m]


class Draft(NamedTuple):
    """A fit of one kind: the least cost to expect of its shape [m], and how to make the shape."""

    least: float
    finish: Callable[[], Shape]


class Kind(NamedTuple):
    """A kind of shape."""

    method: str  # its name in the dataset
    freedom: float  # cost of its freedom to follow the picture [m]
    make: Callable[[ObjectView, RaySample], Draft | None]  # the best fit
    unavoidable: float | None = None  # misfit of even the true shape [m], if it is not that of most kinds


class _Search:
    """Drafts of several kinds, which are finished as late as possible, and the best shape so far.

    Drafts of which more than `most` is expected [m] are not finished.
    """

    def __init__(self, most: float) -> None:
        self.most = most
        self.best: tuple[float, str, TriangleMesh, Pose] | None = None
        self.reasons: list[str] = []
        self._drafts: list[tuple[float, float, str, Draft]] = []

    def add(self, method: str, freedom: float, draft: Draft) -> None:
        """Add a draft of a kind whose freedom to follow the picture costs that much [m]."""
        self._drafts.append((draft.least + freedom, freedom, method, draft))

    def is_below(self, cost: float) -> bool:
        """Whether the best shape costs less [m]; only drafts that may do so are finished."""
        if any(least < cost for least, *_ in self._drafts):
            self.finish()
        return self.best is not None and self.best[0] < cost

    def finish(self) -> None:
        """Finish the drafts that may be the best."""
        for least, freedom, method, draft in sorted(self._drafts, key=lambda entry: entry[0]):
            if least > self.most or (self.best is not None and self.best[0] <= least):
                break
            try:
                mesh, pose, cost = draft.finish()
            except GeometryError as error:
                self.reasons.append(str(error))
                continue
            if self.best is None or cost + freedom < self.best[0]:
                self.best = (cost + freedom, method, mesh, pose)
        self._drafts = []


def complete_by_carving(scene: PerceivedObjects, view: ObjectView) -> Completion:  # noqa: ARG001
    """Fit boxes, surfaces of revolution, solids of a half turn, sheets, inflation and columns, and select the best.

    A box or turned shape takes the place of a free one that follows errors of a sensor's depth, if it fits.

    Raises:
        GeometryError: if no shape explains the points, or the best one lies far from them.
    """
    kinds, unavoidable = (ESTIMATED_KINDS, ESTIMATED_UNAVOIDABLE_M) if view.estimated else (KINDS, UNAVOIDABLE_M)
    search = try_kinds(kinds, view, sample_rays(view), unavoidable)
    if search.best is None:
        raise GeometryError("; ".join(dict.fromkeys(search.reasons)) or "no shape explains the points")
    _, method, mesh, pose = search.best
    if method in FREE and not view.estimated:
        method, mesh, pose = _find_plain(view, method, mesh, pose) or (method, mesh, pose)
    if view.support.leaning:
        mesh = extend_to_floor(mesh, pose, view.points, view.support_z)
    _check_distance(view, mesh, pose)
    return Completion(mesh, pose, method)


def _check_distance(view: ObjectView, mesh: TriangleMesh, pose: Pose) -> None:
    """Refuse a shape far from the readings, before it cuts into its neighbours."""
    residual_m = measure_median_distance(view.points, place_mesh(mesh, pose))
    distance_m = float(np.median(np.linalg.norm(view.points - view.eye, axis=1)))
    if residual_m > MAX_RESIDUAL_SHARE * distance_m:
        raise GeometryError(
            f"the best shape lies {1e3 * residual_m:.0f} mm from what was read {distance_m:.2f} m away, in the median; "
            f"at most {1e3 * MAX_RESIDUAL_SHARE * distance_m:.0f} mm are allowed"
        )


def _find_plain(view: ObjectView, method: str, mesh: TriangleMesh, pose: Pose) -> tuple[str, TriangleMesh, Pose] | None:
    """Find a shape of few numbers in place of a free one.

    It explains the picture nearly as well, the depth weighed as if a model had estimated it; where errors of the depth
    tore the free shape, as well as one must there.
    """
    rays = sample_rays(view, estimated=True)
    extra = min(MOST_EXTRA_M, DENTED_M * (1.0 - measure_fullness(mesh)))
    kinds, most = SOLID_KINDS, compute_mesh_misfit(rays, mesh, pose) + extra
    if is_torn(view, method, mesh):
        kinds, most = PLAIN_KINDS, max(most, MOST_PLAIN_M)
    best = try_kinds(kinds, view, rays, 0.0, most).best
    return None if best is None or best[0] > most or hides_others(view, *best[2:]) else best[1:]


def try_kinds(
    kinds: tuple[Kind, ...], view: ObjectView, rays: RaySample, unavoidable: float, most: float = np.inf
) -> _Search:
    """Search the best shape of some kinds that costs at most `most` [m], or a dearer one that is made anyway.

    `unavoidable` is the misfit of even the true shape [m].
    """
    search = _Search(most)
    for kind in kinds:
        if search.is_below(kind.freedom + (kind.unavoidable or unavoidable)):
            continue
        try:
            draft = kind.make(view, rays)
        except GeometryError as error:
            search.reasons.append(str(error))
            continue
        if draft is not None:
            search.add(kind.method, kind.freedom, draft)
    search.finish()
    return search


def _draft_upright(view: ObjectView, rays: RaySample, discount: float = 0.0) -> Draft:
    """Draft a box that stands, whose upright edges are rounded where that explains the picture better."""
    sharp = fit_upright_box(view, rays)
    price = _price_box(sharp, discount)

    def finish() -> Shape:
        rounded = round_edges(view, rays, sharp)
        if rounded is None or rounded.misfit + LEAST_GAIN_M > sharp.misfit:
            return build_box_mesh(sharp), sharp.pose, price
        return build_box_mesh(rounded), rounded.pose, min(rounded.misfit + ROUNDED_M, price)

    return Draft(min(sharp.misfit - max(MOST_GAIN_M, MOST_GAIN_SHARE * sharp.misfit), price), finish)


def _draft_box(box: SolidBox, discount: float = 0.0) -> Draft:
    price = _price_box(box, discount)
    return Draft(price, lambda: (build_box_mesh(box), box.pose, price))


def _price_box(box: SolidBox, discount: float) -> float:
    return box.misfit - min(discount * box.misfit, BOX_DISCOUNT_M)


def _draft_turned(view: ObjectView, rays: RaySample, fit: TurnedFit | None) -> Draft | None:
    return None if fit is None else Draft(fit.least, lambda: _build_turned(view, rays, *fit.finish()))


def _build_turned(view: ObjectView, rays: RaySample, profile: TurnedProfile, cost: float) -> Shape:
    # The cost stays that of the body: handles decide nothing between kinds, as their own depth is a guess
    mesh, pose, _ = join_handles(view, rays, *build_turned_solid(profile), profile.frame)
    return mesh, pose, cost


def _draft_vessel(view: ObjectView, rays: RaySample) -> Draft | None:
    """Draft a turned shape whose cavity was seen: where smeared depth tears a surface of revolution, it stays whole."""
    if (fit := fit_vessel(view, rays)) is None:
        return None

    def finish() -> Shape:
        profile, _ = fit.finish()
        mesh, pose, cost = join_handles(view, rays, *build_turned_solid(profile), profile.frame)
        return mesh, pose, cost - HOLLOW_BONUS_M

    return Draft(fit.least - HOLLOW_BONUS_M - SIMPLER_M, finish)


def _draft_plain_turned(view: ObjectView, rays: RaySample) -> Draft | None:
    """Draft a turned shape fitted to the depth as measured; to rays that doubt it, where that misses too much."""
    for given in (sample_rays(view), rays):
        profile, _ = fit_standing(view, given).finish()
        misfit = compute_misfit(rays, intersect_turned(rays, profile))
        if misfit < MOST_PLAIN_M:
            cost = misfit - (HOLLOW_BONUS_M if shows_cavity(rays, profile) else 0.0)
            return _draft_fitted(view, rays, profile, cost)
    return None


def _draft_plain_solid(view: ObjectView, rays: RaySample) -> Draft:
    """Draft a turned solid fitted to the depth as measured."""
    profile, _ = fit_solid(view, sample_rays(view)).finish()
    return _draft_fitted(view, rays, profile, compute_misfit(rays, intersect_turned(rays, profile)))


def _draft_fitted(view: ObjectView, rays: RaySample, profile: TurnedProfile, cost: float) -> Draft:
    return Draft(cost, lambda: _build_turned(view, rays, profile, cost))


def _draft_revolution(view: ObjectView, rays: RaySample) -> Draft | None:
    if (fit := fit_revolution(view, rays)) is None:
        return None
    mesh, pose, misfit, hollow = fit
    cost = misfit - (HOLLOW_BONUS_M if hollow else 0.0)
    draft = Draft(cost, lambda: (mesh, pose, cost))
    # Without a cavity it stays round: in so much volume the deviation is little, and others stand on it
    return _bend(view, draft) if hollow else draft


def _draft_sheet(view: ObjectView, rays: RaySample) -> Draft | None:
    carved = carve_sheet(view)
    return None if carved is None else _bend(view, _draft_carving(carved, rays, lambda _: 0.0))


def _bend(view: ObjectView, draft: Draft) -> Draft:
    """Let what the draft makes follow the seen surface, at the same cost: all kinds compete as they were fitted."""

    def finish() -> Shape:
        mesh, pose, cost = draft.finish()
        return warp_to_depth(mesh, pose, view), pose, cost

    return Draft(draft.least, finish)


def _draft_carving(carved: CarvedSurface, rays: RaySample, price: Callable[[TriangleMesh], float]) -> Draft:
    """Draft a carved shape, of which simplification costs the most: as it is it tells how well it can fit."""

    def finish() -> Shape:
        mesh = carved.simplify()
        return mesh, carved.pose, compute_mesh_misfit(rays, mesh, carved.pose) + price(mesh)

    return Draft(compute_mesh_misfit(rays, carved.mesh, carved.pose) - SIMPLER_M, finish)


def _price_raggedness(mesh: TriangleMesh) -> float:
    """Price a surface torn by free space at an occluder [m]."""
    try:
        hull = float(ConvexHull(mesh.vertices).area)
    except QhullError as error:
        raise GeometryError("what free space leaves is flat") from error
    return RAGGED_M * max(compute_surface_area(mesh) / hull - SMOOTH, 0.0)


# In the order of trial: the fewer freedoms a kind has, the earlier and the cheaper, but for the dearest.
KINDS = (
    Kind("carved/box", 0.0, lambda view, rays: _draft_upright(view, rays, BOX_DISCOUNT)),
    Kind("carved/revolution", 1e-4, _draft_revolution),
    Kind("carved/leaning_box", 3e-4, lambda view, rays: _draft_box(fit_leaning_box(view, rays), BOX_DISCOUNT)),
    Kind("carved/half_turn", 5e-4, lambda view, rays: _draft_carving(carve_half_turn(view), rays, _price_raggedness)),
    Kind("carved/sheet", 1e-3, _draft_sheet),
    Kind("carved/inflation", 1.5e-3, lambda view, rays: _draft_carving(inflate(view), rays, lambda _: 0.0)),
    Kind("carved/columns", 2.6e-3, lambda view, rays: _draft_carving(carve_columns(view), rays, lambda _: 0.0)),
    Kind("carved/turned", 3e-4, _draft_vessel, FEW_NUMBERS_M),
)

OUTLINED_LYING = Kind("carved/lying", 3e-4, lambda view, rays: _draft_turned(view, rays, fit_lying(view, rays)))

# The same for depth that a model estimated, whose errors a free shape follows.
ESTIMATED_KINDS = (
    Kind("carved/box", 0.0, lambda view, rays: _draft_box(fit_upright_box(view, rays))),
    Kind("carved/turned", 0.0, lambda view, rays: _draft_turned(view, rays, fit_standing(view, rays))),
    OUTLINED_LYING,
    Kind("carved/leaning_box", 6e-4, lambda view, rays: _draft_box(fit_leaning_box(view, rays))),
    Kind("carved/half_turn", 3e-3, lambda view, rays: _draft_carving(carve_half_turn(view), rays, _price_raggedness)),
    Kind("carved/inflation", 3.5e-3, lambda view, rays: _draft_carving(inflate(view), rays, lambda _: 0.0)),
    Kind("carved/columns", 5e-3, lambda view, rays: _draft_carving(carve_columns(view), rays, lambda _: 0.0)),
)

PLAIN_BOX = Kind("carved/box", 0.0, _draft_upright)

# What is tried where errors of a sensor's depth tear all that follows it: shapes of few numbers average them.
PLAIN_KINDS = (PLAIN_BOX, Kind("carved/turned", 0.0, _draft_plain_turned), OUTLINED_LYING)

# And where they dent it: what has a cavity became a vessel before.
SOLID_KINDS = (PLAIN_BOX, Kind("carved/turned", 0.0, _draft_plain_solid), OUTLINED_LYING)
