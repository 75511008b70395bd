"""Placement domains Ω of relations, as rectangles from the reference's box (paper, appendix D).

The paper's six predicates cover eight of the ten relations of a task; `next to` and `outside` are added. Directions are
those of `geometry.relations`: left is -x, right +x, in front -y, behind +y.
"""

from dataclasses import dataclass

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


_ALL_SIDES = ((0, 1.0), (0, -1.0), (1, -1.0), (1, 1.0))
# Sides of the reference, as axis and sign, on which the object may stand; all other relations put it on or in
SIDES: dict[Relation, tuple[tuple[int, float], ...]] = {
    Relation.LEFT: ((0, -1.0),),
    Relation.RIGHT: ((0, 1.0),),
    Relation.IN_FRONT: ((1, -1.0),),
    Relation.BEHIND: ((1, 1.0),),
    Relation.NEXT_TO: _ALL_SIDES,
    Relation.OUTSIDE: _ALL_SIDES,
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
    relation: Relation, half_xy: Vector2, y: BodyFeatures, delta_margin_m: float
) -> tuple[PlacementRegion, ...]:
    """Build Ω of a relation, as rectangles for the middle of the placed object's box.

    `on` and `in` give the face of the reference's box; the level follows from lowering the object. A side is as wide
    as the reference and begins where the two boxes are `delta_margin_m` apart, so the whole object is beyond the
    margin; it ends `DOMAIN_DEPTH_M` further. `next to` has all four sides up to the relation's gap, and begins no later
    than halfway to it. `half_xy` are half extents of the object's box as it will stand [m].
    """
    if relation not in SIDES:
        return (PlacementRegion(y.low[:2], y.high[:2]),)
    nearest, furthest = delta_margin_m, delta_margin_m + DOMAIN_DEPTH_M
    if relation is Relation.NEXT_TO:
        nearest, furthest = min(nearest, NEXT_TO_GAP_M / 2), NEXT_TO_GAP_M - NEXT_TO_MARGIN_M
    regions = []
    for axis, sign in SIDES[relation]:
        low, high = y.low[:2].copy(), y.high[:2].copy()
        face = y.high[axis] if sign > 0 else y.low[axis]
        low[axis], high[axis] = sorted(face + sign * (half_xy[axis] + gap) for gap in (nearest, furthest))
        regions.append(PlacementRegion(low, high))
    return tuple(regions)


def sample_regions(regions: tuple[PlacementRegion, ...], count: int, rng: np.random.Generator) -> Points2:
    """Sample points uniformly over the regions' area; none where all are empty. Shape (count, 2) or (0, 2)."""
    areas = np.array([region.area for region in regions])
    if not areas.sum() > 0.0:
        return np.zeros((0, 2))
    chosen = rng.choice(len(regions), size=count, p=areas / areas.sum())
    low, high = (np.stack([getattr(region, end) for region in regions])[chosen] for end in ("low", "high"))
    return low + rng.random((count, 2)) * (high - low)
