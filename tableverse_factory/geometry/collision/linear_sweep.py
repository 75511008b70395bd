"""Linear sweeps: how far a body must move along a direction until it is clear of everything (paper equation (2)).

For convex A and B the distance between A + d v and B is a convex function of d, so the d at which they are nearer than
a margin form one interval. Newton's steps from outside (conservative advancement) reach its ends without passing them.
"""

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import coal
import numpy as np

from schemas.geometry import Matrix3, Points, Vector3
from tableverse_factory.geometry.collision.solids import Solids, find_near_pieces

TOLERANCE_M = 1e-7  # gaps are known to this; what is clear to within it counts as clear
MIN_MARGIN_M = 1e-6  # least clearance: disjoint is a little more than touching
GJK_TOLERANCE = 1e-9
MAX_STEPS = 200  # of Newton; three to six are usual. Stopping early leaves more room than needed, never less


@dataclass(frozen=True, slots=True, eq=False)
class MovingSolid:
    """An object's pieces as they were placed, its offset since, and how far its mesh may stick out of them [m]."""

    solids: Solids
    offset: Vector3
    uncovered_m: float = 0.0

    def moved(self, by: Vector3) -> "MovingSolid":
        """Translate by another `by` [m]."""
        return replace(self, offset=self.offset + by)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two pieces, one of which moves, and the range of d outside which their boxes are apart."""

    moving: Solids
    piece: int
    fixed: Solids
    other: int
    start: Vector3
    margin: float
    low: float
    high: float


class LinearSweep:
    """A direction (unit vector in the table frame) along which bodies move, and the exact distances along it."""

    def __init__(self, direction: Vector3) -> None:
        self._direction = direction
        self._axes = complete_basis(direction)
        self._request = coal.DistanceRequest()
        self._request.enable_signed_distance = False
        self._request.gjk_tolerance = GJK_TOLERANCE
        self._result = coal.DistanceResult()
        self._pose = coal.Transform3s()
        self._still = coal.Transform3s()

    def find_first_clear(
        self, moving: Iterable[MovingSolid], fixed: Sequence[MovingSolid], clearance_m: float
    ) -> float:
        """Find the smallest d >= 0 [m] at which every moving body, moved by d, is clear of every fixed body.

        Clear means at least `clearance_m` apart, and further by what either mesh sticks out of its pieces.
        """
        search = self.search(moving, fixed, clearance_m)
        while not search.done:
            search.advance()
        return search.d

    def search(self, moving: Iterable[MovingSolid], fixed: Sequence[MovingSolid], clearance_m: float) -> "ClearSearch":
        """Begin the search of `find_first_clear`, for those who may not need its end."""
        return ClearSearch(
            self, [p for body in moving for other in fixed for p in self._pairs(body, other, clearance_m)]
        )

    def room(
        self, moving: Iterable[MovingSolid], fixed: Sequence[MovingSolid], clearance_m: float, limit_m: float
    ) -> float:
        """Find how far the moving bodies can go before one is no longer clear of a fixed one, 0 to `limit_m` [m].

        It is 0 where they are not clear to begin with, unless they are leaving.
        """
        room = limit_m
        for body in moving:
            for other in fixed:
                for pair in self._pairs(body, other, clearance_m):
                    if pair.low < room:
                        room = self._lower_end(pair, room)
        return max(room, 0.0)

    def _lower_end(self, pair: _Pair, limit: float) -> float:
        d = max(pair.low, 0.0)
        for _ in range(MAX_STEPS):
            gap, slope = self.probe(pair, d)
            if slope >= 0.0 and gap > 0.0:
                return limit
            if gap - pair.margin <= TOLERANCE_M:
                return d
            d -= (gap - pair.margin) / slope
            if d >= limit:
                return limit
        return d

    def find_upper_end(self, pair: _Pair) -> float:
        """Find the d beyond which the pair is clear [m]."""
        d = pair.high
        for _ in range(MAX_STEPS):
            gap, slope = self.probe(pair, d)
            if gap - pair.margin <= TOLERANCE_M or slope <= 0.0:
                break
            d -= (gap - pair.margin) / slope
        return d

    def probe(self, pair: _Pair, d: float) -> tuple[float, float]:
        """Distance of the two pieces at d [m], 0 where they overlap, and its derivative by d."""
        self._pose.setTranslation(pair.start + d * self._direction)
        self._result.clear()
        moving, fixed = pair.moving.shape(pair.piece), pair.fixed.shape(pair.other)
        gap = coal.distance(moving, self._pose, fixed, self._still, self._request, self._result)
        return max(gap, 0.0), -float(self._result.normal @ self._direction)

    def _pairs(self, a: MovingSolid, b: MovingSolid, clearance_m: float) -> list[_Pair]:
        margin = max(clearance_m + a.uncovered_m + b.uncovered_m, MIN_MARGIN_M)
        low_a, high_a = self._extents(a)
        low_b, high_b = self._extents(b)
        first = low_b[None] - high_a[:, None] - margin
        last = high_b[None] - low_a[:, None] + margin
        across = (first[..., 1:] < 0.0).all(axis=2) & (last[..., 1:] > 0.0).all(axis=2)
        start = a.offset - b.offset
        return [
            _Pair(a.solids, int(i), b.solids, int(j), start, margin, float(first[i, j, 0]), float(last[i, j, 0]))
            for i, j in np.argwhere(across & (last[..., 0] > 0.0))
        ]

    def _extents(self, body: MovingSolid) -> tuple[Points, Points]:
        """Lowest and highest coordinates of each piece in the basis that begins with the direction."""
        along, shift, starts = body.solids.points @ self._axes, body.offset @ self._axes, body.solids.starts
        return np.minimum.reduceat(along, starts) + shift, np.maximum.reduceat(along, starts) + shift


class ClearSearch:
    """Search for the smallest d >= 0 at which all pairs are clear; `d` is a lower bound of it until `done` [m].

    Each pair waits on a heap until d reaches the value before which it cannot touch.
    """

    def __init__(self, sweep: LinearSweep, pairs: Sequence[_Pair]) -> None:
        self._sweep, self._pairs = sweep, pairs
        self._waiting = [(pair.low, k) for k, pair in enumerate(pairs)]
        heapq.heapify(self._waiting)
        self.d = 0.0

    @property
    def done(self) -> bool:
        """Whether no pair can touch at `d`."""
        return not self._waiting or self._waiting[0][0] > self.d

    def advance(self) -> None:
        """Test the next pair."""
        _, k = heapq.heappop(self._waiting)
        pair = self._pairs[k]
        if pair.high <= self.d:
            return
        gap, slope = self._sweep.probe(pair, self.d)
        if gap < pair.margin - TOLERANCE_M:
            self.d = self._sweep.find_upper_end(pair)
        elif slope < 0.0:  # free here, and approaching: not before the tangent reaches the margin
            heapq.heappush(self._waiting, (self.d + max((pair.margin - gap) / slope, TOLERANCE_M), k))


def are_within(a: MovingSolid, b: MovingSolid, reach_m: float) -> bool:
    """Whether any piece of one body comes within `reach_m` [m] of a piece of the other."""
    return any(True for _ in find_near_pieces(a.solids, b.solids, reach_m, a.offset - b.offset, signed=False))


def find_nearest_point(a: MovingSolid, b: MovingSolid, reach_m: float) -> tuple[float, Vector3]:
    """Find how near two bodies come [m], 0 where they overlap, and where on the first; inf and NaN beyond `reach_m`."""
    least, where = np.inf, np.full(3, np.nan)
    for gap, result in find_near_pieces(a.solids, b.solids, reach_m, a.offset - b.offset):
        if max(gap, 0.0) < least:
            least, where = max(gap, 0.0), np.array(result.getNearestPoint1()) + b.offset
    return float(least), where


def complete_basis(direction: Vector3) -> Matrix3:
    """Complete a unit vector to an orthonormal basis, as columns."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    second = np.cross(direction, helper)
    second /= np.linalg.norm(second)
    return np.column_stack([direction, second, np.cross(direction, second)])
