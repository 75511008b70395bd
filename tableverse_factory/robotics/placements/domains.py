"""Placement domains Ω of relations, as rectangles from the reference's box (paper, appendix D).

The paper names six predicates; the ten relations of a task are mapped to them and to two more, `next to` and `outside`.
Directions are those of `geometry.relations`: left is -x, right +x, in front -y, behind +y.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float64

from schemas.curation import Relation
from schemas.geometry import Frozen
from tableverse_factory.geometry.relations.relations import NEXT_TO_GAP_M, BodyFeatures

Vector2 = Float64[np.ndarray, "2"]
Points2 = Float64[np.ndarray, "n 2"]
# Extent of a half-space beyond its margin, within common usage of `to the left of` and an arm's reach
DOMAIN_DEPTH_M = 0.25
NEXT_TO_MARGIN_M = 0.01  # `next to` placements stay closer than the relation's limit by this


class Predicate(StrEnum):
    """Domain shape."""

    TOP = "top"
    IN = "in"
    LEFT = "left"
    RIGHT = "right"
    FRONT = "front"
    BACK = "back"
    NEXT_TO = "next to"
    OUTSIDE = "outside"


PREDICATES = {
    Relation.ON: Predicate.TOP,
    Relation.IN: Predicate.IN,
    Relation.INTO: Predicate.IN,
    Relation.INSIDE: Predicate.IN,
    Relation.LEFT: Predicate.LEFT,
    Relation.RIGHT: Predicate.RIGHT,
    Relation.IN_FRONT: Predicate.FRONT,
    Relation.BEHIND: Predicate.BACK,
    Relation.NEXT_TO: Predicate.NEXT_TO,
    Relation.OUTSIDE: Predicate.OUTSIDE,
}

_SIDES = {
    Predicate.LEFT: ((0, -1.0),),
    Predicate.RIGHT: ((0, 1.0),),
    Predicate.FRONT: ((1, -1.0),),
    Predicate.BACK: ((1, 1.0),),
    Predicate.NEXT_TO: ((0, 1.0), (0, -1.0), (1, -1.0), (1, 1.0)),
    Predicate.OUTSIDE: ((0, 1.0), (0, -1.0), (1, -1.0), (1, 1.0)),
}


@dataclass(frozen=True, slots=True, eq=False)
class PlacementRegion(Frozen):
    """Rectangle of box middles along the table's axes [m]; it may be empty."""

    low: Vector2
    high: Vector2

    @property
    def area(self) -> float:
        """Area [m²]; 0 where empty."""
        return float(np.prod(np.maximum(self.high - self.low, 0.0)))

    def intersect(self, low: Vector2, high: Vector2) -> "PlacementRegion":
        """Intersect with another rectangle."""
        return PlacementRegion(np.maximum(self.low, low), np.minimum(self.high, high))

    def contains(self, middles: Points2) -> Bool[np.ndarray, " n"]:
        """Test which points lie inside."""
        return np.all((middles >= self.low) & (middles <= self.high), axis=1)


def build_domain(
    predicate: Predicate, half_xy: Vector2, y: BodyFeatures, delta_margin_m: float
) -> tuple[PlacementRegion, ...]:
    """Build Ω of a predicate, as rectangles for the middle of the placed object's box.

    `top` and `in` give the face of the reference's box; the level follows from lowering the object. A side is as wide
    as the reference and begins where the two boxes are `delta_margin_m` apart, so the whole object is beyond the
    margin; it ends `DOMAIN_DEPTH_M` further. `next to` has all four sides up to the relation's gap, and begins no later
    than halfway to it. `outside` has all four. `half_xy` are half extents of the object's box as it will stand [m].
    """
    if predicate in (Predicate.TOP, Predicate.IN):
        return (PlacementRegion(y.low[:2], y.high[:2]),)
    nearest, furthest = delta_margin_m, delta_margin_m + DOMAIN_DEPTH_M
    if predicate is Predicate.NEXT_TO:
        nearest, furthest = min(nearest, NEXT_TO_GAP_M / 2), NEXT_TO_GAP_M - NEXT_TO_MARGIN_M
    return tuple(_build_side_region(axis, sign, half_xy, y, nearest, furthest) for axis, sign in _SIDES[predicate])


def _build_side_region(
    axis: int, sign: float, half_xy: Vector2, y: BodyFeatures, nearest: float, furthest: float
) -> PlacementRegion:
    low, high = y.low[:2].copy(), y.high[:2].copy()
    face = y.high[axis] if sign > 0 else y.low[axis]
    ends = sorted(face + sign * (half_xy[axis] + gap) for gap in (nearest, furthest))
    low[axis], high[axis] = ends
    return PlacementRegion(low, high)


def sample_regions(regions: tuple[PlacementRegion, ...], count: int, rng: np.random.Generator) -> Points2:
    """Sample points uniformly over the regions' area; none where all are empty. Shape (count, 2) or (0, 2)."""
    areas = np.array([region.area for region in regions])
    if not areas.sum() > 0.0:
        return np.zeros((0, 2))
    chosen = rng.choice(len(regions), size=count, p=areas / areas.sum())
    low, high = (np.stack([getattr(region, end) for region in regions])[chosen] for end in ("low", "high"))
    return low + rng.random((count, 2)) * (high - low)
