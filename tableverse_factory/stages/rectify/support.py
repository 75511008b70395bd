"""Support relations (carrying, containing, leaning) inferred from a noisy layout."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep, are_within, find_nearest_point
from tableverse_factory.stages.rectify.rigid_part import RigidPart, Vector2

TILT_NOISE_DEG = 3.0  # an object is as good as upright if it would stand when tilted by up to this
BASIN_DEG = 6.0  # so far tilted, a standing object has its centre of mass higher than for some tilt within the noise
BASIN_TOLERANCE_M = 2e-4  # round objects stand in any direction: their centre of mass must not sink by more than this
ON_TABLE_M = 0.008  # an object whose lowest vertex is higher than this does not stand on the table
HANGING_M = 0.015  # noise does not lift an object higher than this: something carries it, wherever it touches it

VERTICAL_NOISE_M = 0.012  # an object that must rise or sink by no more than this to lie upon another may lie upon it
STEEP_NOISE_M = 0.025  # so at steep edges, which turn sideways noise into height, if the opposite is twice as far
NEEDY_REACH = 1.5  # factor on the contact distance for an object that could not stand alone
LEANING_REACH_M = 0.02  # noise may have moved an object this far from the one it leans on

Outline = Float64[np.ndarray, "n 3"]  # half planes (normal, offset) around a footprint


@dataclass(frozen=True, slots=True)
class SupportRelation:
    """Pairs (upper, lower) of a part and what carries, contains or props it, and whether each part stands alone."""

    pairs: frozenset[tuple[int, int]]
    standing: tuple[bool, ...]

    def rise(self, i: int, j: int) -> float:
        """1 where j carries i, -1 where i carries j, 0 where neither."""
        return 1.0 if (i, j) in self.pairs else -1.0 if (j, i) in self.pairs else 0.0

    def of(self, some: Sequence[int]) -> "SupportRelation":
        """Select the relations among some of the parts, renumbered."""
        place = {i: k for k, i in enumerate(some)}
        pairs = frozenset((place[i], place[j]) for i, j in self.pairs if i in place and j in place)
        return SupportRelation(pairs, tuple(self.standing[i] for i in some))

    def adding(self, upper: int, lower: int) -> "SupportRelation":
        """Add a pair; its upper part then stands no longer."""
        standing = tuple(stands and i != upper for i, stands in enumerate(self.standing))
        return SupportRelation(self.pairs | {(upper, lower)}, standing)


def read_support(parts: Sequence[RigidPart], contact_m: float) -> SupportRelation:
    """Infer support from heights, contact, footprints and centres of mass.

    Of two near parts, one carries the other if that one could not stand alone, or has its centre of mass above the
    other's footprint. The upper one is the one that must rise or sink less to lie upon the other: by the order of the
    noise, instead of an object's height. A part that could not stand alone and has no support so far leans on the
    nearest part on the side to which it would fall; one that hangs in the air, on the nearest on any side. Where all
    that it touches was read as carried by it, the one upon which it would lie soonest carries it instead, within noise.
    """
    reader = _Reader(parts)
    pairs: set[tuple[int, int]] = set()
    for i, j in combinations(range(len(parts)), 2):
        reach = NEEDY_REACH * contact_m if reader.needy[i] or reader.needy[j] else contact_m
        upper = reader.upper(i, j) if are_within(parts[i].body, parts[j].body, reach) else None
        if upper is not None:
            pairs.add((upper, i + j - upper))
    for i in sorted(range(len(parts)), key=lambda i: (-parts[i].lowest_now_m, parts[i].object_id)):
        if reader.needy[i] and all(upper != i for upper, _ in pairs):
            lower = reader.leans_on(i, [j for j in range(len(parts)) if j != i and (j, i) not in pairs])
            pairs |= set() if lower is None else {(i, lower)}
    reader.turn_hanging(pairs)
    uppers = {upper for upper, _ in pairs}
    return SupportRelation(frozenset(pairs), tuple(i not in uppers for i in range(len(parts))))


def measure_vertical_gap(upper: RigidPart, lower: RigidPart) -> float:
    """Measure how far a part must rise or sink to lie upon another one [m]."""
    rise = _RISING.find_first_clear([upper.body], [lower.body], 0.0)
    return rise if rise > 0.0 else _SINKING.room([upper.body], [lower.body], 0.0, np.inf)


class _Reader:
    def __init__(self, parts: Sequence[RigidPart]) -> None:
        self._parts = parts
        self._falls = [_find_fall_direction(part) for part in parts]
        self._outlines = [_compute_half_planes((part.body.solids.points + part.body.offset)[:, :2]) for part in parts]
        self._hovers = [part.lowest_now_m > ON_TABLE_M for part in parts]
        self._hangs = [part.lowest_now_m > HANGING_M for part in parts]
        self._ranks = [(-float(part.mass_center_now[2]), part.object_id) for part in parts]
        # Parts that the table alone cannot carry, within the noise of their poses.
        self.needy = [fall is not None or hovers for fall, hovers in zip(self._falls, self._hovers, strict=True)]

    def upper(self, i: int, j: int) -> int | None:
        """Decide which of two near parts is supported by the other; None if neither."""
        over = {i: self._is_over(i, j), j: self._is_over(j, i)}
        needy, ranks = self.needy, self._ranks
        if not (over[i] or over[j] or needy[i] or needy[j]):
            return None
        off = {i: self._off(i, j), j: self._off(j, i)}
        likely = [k for k in (i, j) if off[k] <= VERTICAL_NOISE_M and (needy[k] or over[k])]
        if likely:
            return min(likely, key=lambda k: (not needy[k], off[k], ranks[k]))
        if (over[i] or over[j]) and max(off.values()) > 2 * min(off.values()):
            return min((i, j), key=lambda k: off[k])
        if over[i] or over[j]:
            return min((i, j), key=lambda k: (not self._hovers[k], not needy[k], off[k], ranks[k]))
        steep = [k for k in (i, j) if needy[k] and off[k] <= min(STEEP_NOISE_M, off[i + j - k] / 2)]
        return min(steep, key=lambda k: (off[k], ranks[k]), default=None)

    def leans_on(self, i: int, others: Sequence[int]) -> int | None:
        """Find the nearest of the others within reach, on the side to which a part would fall unless it hangs."""
        fall = self._falls[i]
        found = []
        for j in others:
            gap, point = find_nearest_point(self._parts[i].body, self._parts[j].body, LEANING_REACH_M)
            side = 0.0 if fall is None else float((point - self._parts[i].mass_center_now)[:2] @ fall)
            if gap <= LEANING_REACH_M and (side >= 0.0 or self._hangs[i]):
                found.append((gap, self._parts[j].object_id, j))
        return min(found)[2] if found else None

    def turn_hanging(self, pairs: set[tuple[int, int]]) -> None:
        """Turn one pair of every hanging part that nothing carries and that carries others, where noise allows it."""
        for i in (i for i, hangs in enumerate(self._hangs) if hangs and all(upper != i for upper, _ in pairs)):
            carried = [(self._off(i, j), self._parts[j].object_id, j) for j, lower in pairs if lower == i]
            if carried and min(carried)[0] <= STEEP_NOISE_M:
                j = min(carried)[2]
                pairs -= {(j, i)}
                pairs |= {(i, j)}

    def _off(self, i: int, j: int) -> float:
        return measure_vertical_gap(self._parts[i], self._parts[j])

    def _is_over(self, i: int, j: int) -> bool:
        outline, center = self._outlines[j], self._parts[i].mass_center_now
        return bool((outline[:, :2] @ center[:2] + outline[:, 2] <= 0.0).all())


def _find_fall_direction(part: RigidPart) -> Vector2 | None:
    """Find the direction in which the part would fall over on the table, beyond the noise; None if it stands."""
    around = part.body.solids.points - part.mass_center
    heights = (around @ _WITHIN_NOISE.T).max(axis=0)
    beyond = (around @ _BEYOND_NOISE.T).max(axis=0)
    lowest = int(np.argmin(beyond))
    if beyond[lowest] >= heights.min() - BASIN_TOLERANCE_M:
        return None
    return _BEYOND_NOISE[lowest, :2] / np.linalg.norm(_BEYOND_NOISE[lowest, :2])


def _compute_half_planes(points: Float64[np.ndarray, "n 2"]) -> Outline:
    try:
        equations: Outline = ConvexHull(points).equations
    except QhullError:  # seen edge-on: no point is over it
        equations = np.array([[0.0, 0.0, 1.0]])
    return equations


def _list_downward_directions(angle_deg: float, count: int) -> Points:
    """List directions at an angle from straight down."""
    angle, azimuth = np.radians(angle_deg), (np.arange(count) + 0.5) * 2 * np.pi / count
    sideways = np.sin(angle) * np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    return np.column_stack([sideways, np.full(count, -np.cos(angle))])


_WITHIN_NOISE = np.concatenate(
    [_list_downward_directions(0.0, 1), *(_list_downward_directions(TILT_NOISE_DEG * k / 3, 12) for k in (1, 2, 3))]
)
_BEYOND_NOISE = _list_downward_directions(BASIN_DEG, 24)
_RISING, _SINKING = LinearSweep(np.array([0.0, 0.0, 1.0])), LinearSweep(np.array([0.0, 0.0, -1.0]))
