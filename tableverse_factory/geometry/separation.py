"""Planes that part convex pieces: what a layout must satisfy to be free, as linear constraints on its motions.

Two convex pieces are apart if along some direction n one lies beyond the other. For a fixed n that is linear in how
the two are moved, so a motion that satisfies a set of such rows, one for each pair of pieces, ends free: not only to
first order. n comes from the nearest points where the two are apart and from the shortest way out where they overlap
(coal's EPA); how far apart they are along it is then measured on their corners, whatever coal answered.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import coal
import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.geometry.clearance import GJK_TOLERANCE, LEAST_MARGIN_M, Body
from tableverse_factory.geometry.solids import Solids, overlapping_boxes

UPRIGHT_STRETCH = 6.0
"""The way out that is sought with z stretched this much is a sideways one wherever there is any."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A direction along which one piece must stay beyond another.

    Attributes:
        direction: Unit vector, from the other body to the one body.
        spare_m: How much further apart along it than they must be the two are [m]; negative where they are too near.
    """

    direction: Vector3
    spare_m: float


class Separator:
    """Finds the planes between two bodies, wherever they are moved."""

    def __init__(self, stretch: float) -> None:
        """Takes by how much the way up is made longer than the ways aside (1: the shortest way counts)."""
        self._factors = np.array([1.0, 1.0, stretch])
        self._stretched: dict[int, tuple[Solids, Solids]] = {}
        self._request = coal.DistanceRequest()
        self._request.gjk_tolerance = GJK_TOLERANCE
        self._result = coal.DistanceResult()
        self._pose = coal.Transform3s()
        self._still = coal.Transform3s()

    def planes(
        self, a: Body, b: Body, clearance_m: float, reach_m: float, instead: Callable[[Vector3], Vector3]
    ) -> Iterator[Plane]:
        """A plane for each pair of pieces that come within `reach_m` of being too near.

        Args:
            a: One body.
            b: The other.
            clearance_m: The gap that counts as apart, further by what either mesh sticks out of its pieces [m].
            reach_m: Pairs further apart than this are left out [m].
            instead: The direction to take in place of the one found, asked where pieces overlap.
        """
        margin = max(clearance_m + a.uncovered_m + b.uncovered_m, LEAST_MARGIN_M)
        shift = a.offset - b.offset
        first, second = self._of(a), self._of(b)
        self._pose.setTranslation(shift * self._factors)
        for i, j in overlapping_boxes(a.solids, b.solids, margin + reach_m, shift):
            self._result.clear()
            gap = coal.distance(first.shape(i), self._pose, second.shape(j), self._still, self._request, self._result)
            direction = -np.array(self._result.normal) * self._factors
            direction /= np.linalg.norm(direction)
            if gap < 0.0:
                direction = instead(direction)
            apart = (a.solids.vertices(i) @ direction).min() - (b.solids.vertices(j) @ direction).max()
            yield Plane(direction, float(apart + shift @ direction) - margin)

    def _of(self, body: Body) -> Solids:
        if (self._factors == 1.0).all():
            return body.solids
        key = id(body.solids)
        if key not in self._stretched:  # the original is kept beside, so that its id stays its own
            self._stretched[key] = (body.solids, body.solids.stretched(self._factors))
        return self._stretched[key][1]
