"""The embedded default MeshModel: the simplest of four kinds of shape that explains the picture."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.geometry import Frozen, Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.errors import GeometryError
from tableverse_factory.place.box import box_mesh, upright_box
from tableverse_factory.place.carved import columns, half_turned
from tableverse_factory.place.completion import Completion
from tableverse_factory.place.explain import Rays, mesh_hits, misfit, rays_of
from tableverse_factory.place.leaning import leaning_box
from tableverse_factory.place.revolution import best_revolution
from tableverse_factory.place.sighting import Sighting

BOX_DISCOUNT_M = 0.0008
"""Flat faces carry the whole error of a depth camera: a free shape follows it, a box must not pay for it."""
GOOD_M = 0.0005
"""A primitive that disagrees with the picture by less is taken without looking further."""


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate(Frozen):
    """A shape and its price: its disagreement with the picture, and more for each freedom it has [m]."""

    method: str
    price: float
    mesh: TriangleMesh
    pose: Pose


def complete_carved(scene: PerceivedObjects, sighting: Sighting) -> Completion:  # noqa: ARG001
    """The best explanation among boxes, a surface of revolution, a half-turn symmetric solid and columns.

    Raises:
        GeometryError: if the points carry no solid.
    """
    rays = rays_of(sighting)
    found: list[_Candidate] = []
    reasons: list[str] = []
    for propose in (_box, _revolution, _leaning, _half_turned, _columns):
        try:
            found.extend(propose(sighting, rays))
        except GeometryError as error:
            reasons.append(str(error))
        if any(candidate.price < GOOD_M for candidate in found):
            break
    if not found:
        raise GeometryError("; ".join(dict.fromkeys(reasons)) or "no shape explains the points")
    best = min(found, key=lambda candidate: candidate.price)
    return Completion(best.mesh, best.pose, best.method)


def _box(sighting: Sighting, rays: Rays) -> list[_Candidate]:
    box = upright_box(sighting, rays)
    return [_Candidate("carved/box", box.misfit - min(0.4 * box.misfit, BOX_DISCOUNT_M), box_mesh(box), box.pose)]


def _leaning(sighting: Sighting, rays: Rays) -> list[_Candidate]:
    box = leaning_box(sighting, rays)
    price = box.misfit - min(0.4 * box.misfit, BOX_DISCOUNT_M) + 3e-4
    return [_Candidate("carved/leaning_box", price, box_mesh(box), box.pose)]


def _revolution(sighting: Sighting, rays: Rays) -> list[_Candidate]:
    fit = best_revolution(sighting, rays)
    return [] if fit is None else [_Candidate("carved/revolution", fit.price + 1e-4, fit.mesh, fit.pose)]


def _half_turned(sighting: Sighting, rays: Rays) -> list[_Candidate]:
    return [_priced("carved/half_turn", half_turned, 5e-4, sighting, rays)]


def _columns(sighting: Sighting, rays: Rays) -> list[_Candidate]:
    return [_priced("carved/columns", columns, 1.6e-3, sighting, rays)]


def _priced(
    method: str, make: Callable[[Sighting], tuple[TriangleMesh, Pose]], freedom: float, sighting: Sighting, rays: Rays
) -> _Candidate:
    mesh, pose = make(sighting)
    return _Candidate(method, misfit(rays, mesh_hits(rays, mesh, pose)) + freedom, mesh, pose)
