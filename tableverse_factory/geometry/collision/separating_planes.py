"""Planes that part convex pieces: what a layout must satisfy to be free, as linear constraints on its motions.

Two convex pieces are apart if along some direction n one lies beyond the other. For a fixed n that is linear in how
the two are translated, so a translation that satisfies such a row for each pair of pieces ends free, not only to first
order. For turns it is so to first order, at each of the corners that are nearest to the plane. n comes from the nearest
points where the two are apart and from the shortest way out where they overlap (coal's EPA); how far apart they are
along it is then measured on their corners, whatever coal answered.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import coal
import numpy as np

from schemas.geometry import Matrix3, Points, Vector3
from tableverse_factory.geometry.collision.ray_clearance import GJK_TOLERANCE
from tableverse_factory.geometry.collision.solids import Solids, convex_shape

SIDEWAYS_STRETCH = 6.0
"""The way out that is sought with z stretched this much is a sideways one wherever there is any."""
CORNER_DEPTH_M = 0.003
"""Corners this much further from a plane than the nearest one may become the nearest in one step [m]."""
ALL_CORNERS_M = 0.006
"""With more room than this, one corner is watched: nothing meets in one step that goes less far [m]."""
CORNERS = 4
"""Corners of either piece that are watched."""
LEAST_RISE = 0.1


class Stance:
    """The pieces of a body, turned and moved.

    Attributes:
        solids: The pieces before.
        rotation: Turns them about the origin.
        shift: Moves them then [m].
        low: Lowest corner of each piece's box. Shape (k, 3) [m].
        high: Highest corner of each piece's box. Shape (k, 3) [m].
        least: Lowest corner of the box of all [m].
        most: Highest corner of the box of all [m].
    """

    def __init__(self, solids: Solids, rotation: Matrix3, shift: Vector3) -> None:
        self.solids, self.rotation, self.shift = solids, rotation, shift
        points = solids.points @ rotation.T + shift
        self._corners = np.split(points, solids.starts[1:])
        self.low: Points = np.minimum.reduceat(points, solids.starts)
        self.high: Points = np.maximum.reduceat(points, solids.starts)
        self.least: Vector3 = self.low.min(axis=0)
        self.most: Vector3 = self.high.max(axis=0)

    def corners(self, piece: int) -> Points:
        """Where the vertices of a piece are [m]."""
        return self._corners[piece]

    def pose(self) -> coal.Transform3s:
        """Turn and motion as coal wants them."""
        return coal.Transform3s(self.rotation, self.shift)

    def stretched(self, piece: int, factors: Vector3) -> coal.Convex:
        """A piece where it is, each axis scaled."""
        return convex_shape(self.corners(piece) * factors, self.solids.faces(piece))


@dataclass(frozen=True, slots=True, eq=False)
class SeparatingPlane:
    """A direction along which one piece must stay beyond another.

    Attributes:
        direction: Unit vector, from the other body to the one body.
        spare_m: How much further apart along it than they must be the two are [m]; negative where they are too near.
        points: Corners near the plane, of the one body as they are, of the other lifted to it. Shape (k, 3) [m].
        spares_m: `spare_m` at each of these corners. Shape (k,).
    """

    direction: Vector3
    spare_m: float
    points: Points
    spares_m: Points


class Separator:
    """Finds the planes between two bodies."""

    def __init__(self) -> None:
        self._request = coal.DistanceRequest()
        self._request.gjk_tolerance = GJK_TOLERANCE
        self._result = coal.DistanceResult()
        self._still = coal.Transform3s()
        self._factors = np.array([1.0, 1.0, SIDEWAYS_STRETCH])

    def planes(self, a: Stance, b: Stance, margin_m: float, reach_m: float, rise: float) -> Iterator[SeparatingPlane]:
        """A plane for each pair of pieces that come within `reach_m` of being nearer than the margin.

        Args:
            a: One body.
            b: The other.
            margin_m: The least distance between the two [m].
            reach_m: Pairs further apart than this are left out [m].
            rise: Where pieces overlap: 1 if the one body belongs above the other, -1 if below, 0 if beside it.
        """
        reach = margin_m + reach_m
        if (a.least > b.most + reach).any() or (b.least > a.most + reach).any():
            return
        near = ~((a.low[:, None] > b.high[None] + reach) | (b.low[None] > a.high[:, None] + reach)).any(axis=2)
        pose_a, pose_b = a.pose(), b.pose()
        for i, j in np.argwhere(near).tolist():
            self._result.clear()
            first, second = a.solids.shape(i), b.solids.shape(j)
            gap = coal.distance(first, pose_a, second, pose_b, self._request, self._result)
            if gap > reach:
                continue
            direction = -np.array(self._result.normal)
            if gap < 0.0:
                direction = self._way_out(a, i, b, j, direction, rise)
            yield _plane(direction, a.corners(i), b.corners(j), margin_m)

    def _way_out(self, a: Stance, i: int, b: Stance, j: int, shortest: Vector3, rise: float) -> Vector3:
        if rise:
            return np.array([0.0, 0.0, rise]) if rise * shortest[2] < -LEAST_RISE else shortest
        self._result.clear()
        first, second = a.stretched(i, self._factors), b.stretched(j, self._factors)
        coal.distance(first, self._still, second, self._still, self._request, self._result)
        direction: Vector3 = -np.array(self._result.normal) * self._factors
        direction /= np.linalg.norm(direction)
        return direction


def cross_matrix(vector: Vector3) -> Matrix3:
    """The matrix M with `a @ M` the cross product of a and the vector."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _plane(direction: Vector3, above: Points, below: Points, margin_m: float) -> SeparatingPlane:
    heights, depths = above @ direction, below @ direction
    least, most = heights.min(), depths.max()
    spare = float(least - most) - margin_m
    if spare > ALL_CORNERS_M:
        first = int(heights.argmin())
        return SeparatingPlane(direction, spare, above[first : first + 1], np.array([spare]))
    of_a = _nearest(heights - least, above, direction)
    of_b = _nearest(most - depths, below, direction)
    lifted = below[of_b] + (most - depths[of_b])[:, None] * direction
    points = np.concatenate([above[of_a], lifted])
    spares = np.concatenate([heights[of_a] - most, least - depths[of_b]]) - margin_m
    return SeparatingPlane(direction, spare, points, spares)


def _nearest(depths: Points, corners: Points, direction: Vector3) -> Sequence[int]:
    """Of the corners near a plane, the nearest and the outermost ones along it."""
    [near] = (depths <= CORNER_DEPTH_M).nonzero()
    if len(near) <= CORNERS:
        return list(near)
    turn = cross_matrix(direction)
    across = turn[int(np.abs(direction).argmin())]
    around, along = corners[near], np.array([across, across @ turn])
    ways = around @ along.T
    chosen = {int(depths[near].argmin()), *ways.argmax(axis=0).tolist(), *ways.argmin(axis=0).tolist()}
    return sorted(near[list(chosen)].tolist())
