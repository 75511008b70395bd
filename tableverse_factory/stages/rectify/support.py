"""Who carries, contains or is leant on by whom, read from a layout that is a little wrong everywhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points
from tableverse_factory.geometry.collision.ray_clearance import Ray, are_within, nearest_point
from tableverse_factory.stages.rectify.rigid_part import RigidPart, Vector2

TILT_NOISE_DEG = 3.0
"""An object is as good as upright if it would stand when tilted by up to this."""
BASIN_DEG = 6.0
"""Tilted by this much, an object that stands has its centre of mass higher than somewhere within the noise."""
BASIN_TOLERANCE_M = 2e-4
"""Round things stand in any direction: their centre of mass need not rise, but must not sink by more than this."""
ON_TABLE_M = 0.008
"""An object whose lowest vertex is higher than this does not stand on the table."""

VERTICAL_NOISE_M = 0.012
"""Something that must rise or sink by no more than this to lie upon another may well lie upon it."""
STEEP_NOISE_M = 0.025
"""The same where a steep edge turns noise sideways into noise in height: if the other way round is twice as far."""
NEEDY_REACH = 1.5
"""What could not stand may have been taken this many times as far from what carries it as counts as contact."""
LEANING_REACH_M = 0.02
"""Noise may have taken something this far from what it leans on."""

Outline = Float64[np.ndarray, "n 3"]
"""Half planes (normal, offset) around a footprint."""


@dataclass(frozen=True, slots=True)
class SupportRelation:
    """What was read.

    Attributes:
        pairs: (upper, lower): the lower one carries, contains or is leant on by the upper one.
        standing: Of each part, whether the table alone carries it.
    """

    pairs: frozenset[tuple[int, int]]
    standing: tuple[bool, ...]

    def rise(self, i: int, j: int) -> float:
        """1 where the other one carries the one, -1 where the one carries the other, 0 where neither."""
        return 1.0 if (i, j) in self.pairs else -1.0 if (j, i) in self.pairs else 0.0

    def of(self, some: Sequence[int]) -> "SupportRelation":
        """What was read of some of the parts, by their places among these."""
        place = {i: k for k, i in enumerate(some)}
        pairs = frozenset((place[i], place[j]) for i, j in self.pairs if i in place and j in place)
        return SupportRelation(pairs, tuple(self.standing[i] for i in some))


def read_support(parts: Sequence[RigidPart], contact_m: float) -> SupportRelation:
    """Support from heights, contact, footprints and where the centre of mass lies.

    Of two that are near one another, one carries the other if that one could not stand as it does, or if its centre of
    mass is above the other's footprint. Which of them is above is a matter of how far it must rise or sink to lie upon
    the other: that is of the order of the noise for the upper one, and of an object's height for the lower one. What
    could not stand and has nothing under it so far leans on the nearest thing on the side to which it would fall.
    """
    reader = _Reader(parts)
    pairs: set[tuple[int, int]] = set()
    for i, j in combinations(range(len(parts)), 2):
        needy = reader.needs_support(i) or reader.needs_support(j)
        reach = NEEDY_REACH * contact_m if needy else contact_m
        upper = reader.upper(i, j) if are_within(parts[i].body, parts[j].body, reach) else None
        if upper is not None:
            pairs.add((upper, i + j - upper))
    for i in sorted(range(len(parts)), key=lambda i: (-parts[i].lowest_now_m, parts[i].object_id)):
        if reader.needs_support(i) and all(upper != i for upper, _ in pairs):
            lower = reader.leans_on(i, [j for j in range(len(parts)) if j != i and (j, i) not in pairs])
            pairs |= set() if lower is None else {(i, lower)}
    uppers = {upper for upper, _ in pairs}
    return SupportRelation(frozenset(pairs), tuple(i not in uppers for i in range(len(parts))))


class _Reader:
    """What is known of each part while pairs are looked at."""

    def __init__(self, parts: Sequence[RigidPart]) -> None:
        self._parts = parts
        self._falls = [_fall(part) for part in parts]
        self._outlines = [_outline((part.body.solids.points + part.body.offset)[:, :2]) for part in parts]
        self._up, self._down = Ray(np.array([0.0, 0.0, 1.0])), Ray(np.array([0.0, 0.0, -1.0]))

    def needs_support(self, i: int) -> bool:
        """Whether the table alone cannot carry the part as it stands, give or take the noise of its pose."""
        return self._falls[i] is not None or self._hovers(i)

    def _hovers(self, i: int) -> bool:
        return self._parts[i].lowest_now_m > ON_TABLE_M

    def upper(self, i: int, j: int) -> int | None:
        """Which of two parts near one another the other one carries, contains or props up; None if neither."""
        over = {i: self._is_over(i, j), j: self._is_over(j, i)}
        needy = {k: self.needs_support(k) for k in (i, j)}
        if not (over[i] or over[j] or needy[i] or needy[j]):
            return None
        off = {i: self._off(i, j), j: self._off(j, i)}
        likely = [k for k in (i, j) if off[k] <= VERTICAL_NOISE_M and (needy[k] or over[k])]
        if likely:
            return min(likely, key=lambda k: (not needy[k], off[k], self._rank(k)))
        if over[i] or over[j]:
            return min((i, j), key=lambda k: (not self._hovers(k), not needy[k], off[k], self._rank(k)))
        steep = [k for k in (i, j) if needy[k] and off[k] <= min(STEEP_NOISE_M, off[i + j - k] / 2)]
        return min(steep, key=lambda k: (off[k], self._rank(k)), default=None)

    def leans_on(self, i: int, others: Sequence[int]) -> int | None:
        """The nearest of the others on the side to which a part would fall, within reach; None if there is none."""
        fall = self._falls[i]
        found = []
        for j in others:
            gap, point = nearest_point(self._parts[i].body, self._parts[j].body, LEANING_REACH_M)
            side = 0.0 if fall is None else float((point - self._parts[i].mass_center_now)[:2] @ fall)
            if gap <= LEANING_REACH_M and side >= 0.0:
                found.append((gap, self._parts[j].object_id, j))
        return min(found)[2] if found else None

    def _rank(self, k: int) -> tuple[float, str]:
        return -float(self._parts[k].mass_center_now[2]), self._parts[k].object_id

    def _off(self, i: int, j: int) -> float:
        """How far a part must rise or sink to lie upon another one [m]."""
        upper, lower = self._parts[i].body, self._parts[j].body
        rise = self._up.first_clear([upper], [lower], 0.0)
        return rise if rise > 0.0 else self._down.room([upper], [lower], 0.0, np.inf)

    def _is_over(self, i: int, j: int) -> bool:
        outline, center = self._outlines[j], self._parts[i].mass_center_now
        return bool((outline[:, :2] @ center[:2] + outline[:, 2] <= 0.0).all())


def _fall(part: RigidPart) -> Vector2 | None:
    """Which way the part would fall over if it stood on the table as it is, give or take the noise; None if not."""
    around = part.body.solids.points - part.mass_center
    heights = (around @ _WITHIN_NOISE.T).max(axis=0)
    beyond = (around @ _BEYOND_NOISE.T).max(axis=0)
    lowest = int(np.argmin(beyond))
    if beyond[lowest] >= heights.min() - BASIN_TOLERANCE_M:
        return None
    way: Vector2 = _BEYOND_NOISE[lowest, :2] / np.linalg.norm(_BEYOND_NOISE[lowest, :2])
    return way


def _outline(points: Float64[np.ndarray, "n 2"]) -> Outline:
    try:
        equations: Outline = ConvexHull(points).equations
    except QhullError:  # seen edge-on: nothing is over it
        equations = np.array([[0.0, 0.0, 1.0]])
    return equations


def _downward(angle_deg: float, count: int) -> Points:
    """Directions at an angle from straight down."""
    angle, azimuth = np.radians(angle_deg), (np.arange(count) + 0.5) * 2 * np.pi / count
    sideways = np.sin(angle) * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    return np.column_stack([sideways, np.full(count, -np.cos(angle))])


_WITHIN_NOISE = np.concatenate([_downward(0.0, 1), *(_downward(TILT_NOISE_DEG * k / 3, 12) for k in (1, 2, 3))])
_BEYOND_NOISE = _downward(BASIN_DEG, 24)
