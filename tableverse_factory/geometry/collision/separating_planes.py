"""Separating planes of convex pieces: collision-free layouts as linear constraints on motions.

Two convex pieces are apart if one lies beyond the other along some direction n. For a fixed n this is linear in their
translations, exactly; in rotations to first order, at each of the corners nearest to the plane. n comes from the
nearest points where the two are apart, and from the shortest way out where they overlap (coal's EPA).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import coal
import numpy as np

from schemas.geometry import Matrix3, Points, Vector3
from tableverse_factory.geometry.collision.linear_sweep import GJK_TOLERANCE
from tableverse_factory.geometry.collision.solids import Solids, make_convex_shape
from tableverse_factory.geometry.math.transforms import cross_matrix

SIDEWAYS_STRETCH = np.array([1.0, 1.0, 6.0])  # so stretched, the shortest way out is sideways wherever there is any
CORNER_DEPTH_M = 0.003  # corners this much further from a plane than the nearest may become the nearest in one step
SINGLE_CORNER_M = 0.006  # with more room than this, one corner is watched: one step goes less far [m]
MAX_CORNERS = 4  # watched corners of either piece
MIN_RISE = 0.1


class PosedPieces:
    """The pieces of a body, rotated about the origin, then shifted [m].

    `low` and `high` are the corners of each piece's box (k, 3), `least` and `most` those of the box of all.
    """

    def __init__(self, solids: Solids, rotation: Matrix3, shift: Vector3) -> None:
        self.solids, self.rotation, self.shift = solids, rotation, shift
        points = solids.points @ rotation.T + shift
        self.corners: list[Points] = np.split(points, solids.starts[1:])
        self.low: Points = np.minimum.reduceat(points, solids.starts)
        self.high: Points = np.maximum.reduceat(points, solids.starts)
        self.least: Vector3 = self.low.min(axis=0)
        self.most: Vector3 = self.high.max(axis=0)

    def stretched(self, piece: int) -> coal.Convex:
        """Stretch a piece where it is."""
        return make_convex_shape(self.corners[piece] * SIDEWAYS_STRETCH, self.solids.faces[piece])


@dataclass(frozen=True, slots=True, eq=False)
class SeparatingPlane:
    """A unit direction from b to a, along which a piece of body a must stay beyond one of b, with distance to spare.

    `points` are the corners near the plane (k, 3) [m], those of b lifted to it; `spares_m` (k,) are theirs.
    """

    direction: Vector3
    spare_m: float
    points: Points
    spares_m: Points


class PlaneFinder:
    """Finds the separating planes of two bodies."""

    def __init__(self) -> None:
        self._request = coal.DistanceRequest()
        self._request.gjk_tolerance = GJK_TOLERANCE
        self._result = coal.DistanceResult()
        self._still = coal.Transform3s()

    def planes(
        self, a: PosedPieces, b: PosedPieces, margin_m: float, reach_m: float, rise: float
    ) -> Iterator[SeparatingPlane]:
        """Find a plane for each pair of pieces that are no further apart than `margin_m + reach_m` [m].

        Where pieces overlap, `rise` is 1 if `a` belongs above `b`, -1 if below, 0 if beside it.
        """
        reach = margin_m + reach_m
        if (a.least > b.most + reach).any() or (b.least > a.most + reach).any():
            return
        near = ~((a.low[:, None] > b.high[None] + reach) | (b.low[None] > a.high[:, None] + reach)).any(axis=2)
        pose_a, pose_b = (coal.Transform3s(body.rotation, body.shift) for body in (a, b))
        for i, j in np.argwhere(near).tolist():
            self._result.clear()
            first, second = a.solids.shape(i), b.solids.shape(j)
            gap = coal.distance(first, pose_a, second, pose_b, self._request, self._result)
            if gap > reach:
                continue
            direction = -np.array(self._result.normal)
            if gap < 0.0:
                direction = self._way_out(a, i, b, j, direction, rise)
            yield _make_plane(direction, a.corners[i], b.corners[j], margin_m)

    def _way_out(self, a: PosedPieces, i: int, b: PosedPieces, j: int, shortest: Vector3, rise: float) -> Vector3:
        if rise:
            return np.array([0.0, 0.0, rise]) if rise * shortest[2] < -MIN_RISE else shortest
        self._result.clear()
        first, second = a.stretched(i), b.stretched(j)
        coal.distance(first, self._still, second, self._still, self._request, self._result)
        direction: Vector3 = -np.array(self._result.normal) * SIDEWAYS_STRETCH
        direction /= np.linalg.norm(direction)
        return direction


def _make_plane(direction: Vector3, above: Points, below: Points, margin_m: float) -> SeparatingPlane:
    heights, depths = above @ direction, below @ direction
    least, most = heights.min(), depths.max()
    spare = float(least - most) - margin_m
    if spare > SINGLE_CORNER_M:
        first = int(heights.argmin())
        return SeparatingPlane(direction, spare, above[first : first + 1], np.array([spare]))
    of_a = _select_corners(heights - least, above, direction)
    of_b = _select_corners(most - depths, below, direction)
    lifted = below[of_b] + (most - depths[of_b])[:, None] * direction
    points = np.concatenate([above[of_a], lifted])
    spares = np.concatenate([heights[of_a] - most, least - depths[of_b]]) - margin_m
    return SeparatingPlane(direction, spare, points, spares)


def _select_corners(depths: Points, corners: Points, direction: Vector3) -> Sequence[int]:
    """Select the nearest of the corners near a plane, and the outermost ones along it."""
    [near] = (depths <= CORNER_DEPTH_M).nonzero()
    if len(near) <= MAX_CORNERS:
        return list(near)
    turn = cross_matrix(direction)
    across = turn[int(np.abs(direction).argmin())]
    around, along = corners[near], np.array([across, across @ turn])
    ways = around @ along.T
    chosen = {int(depths[near].argmin()), *ways.argmax(axis=0).tolist(), *ways.argmin(axis=0).tolist()}
    return sorted(near[list(chosen)].tolist())
