"""Who carries, contains or is leant on by whom, read from a layout that is a little wrong everywhere."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points
from tableverse_factory.geometry.clearance import are_within
from tableverse_factory.rectify.parts import Part

TILT_NOISE_DEG = 3.0
"""An object is as good as upright if it would stand when tilted by up to this."""
BASIN_DEG = 6.0
"""Tilted by this much, an object that stands has its centre of mass higher than somewhere within the noise."""
BASIN_TOLERANCE_M = 2e-4
"""Round things stand in any direction: their centre of mass need not rise, but must not sink by more than this."""
ON_TABLE_M = 0.008
"""An object whose lowest vertex is higher than this does not stand on the table."""

Outline = Float64[np.ndarray, "n 3"]
"""Half planes (normal, offset) around a footprint."""


@dataclass(frozen=True, slots=True)
class Support:
    """What was read.

    Attributes:
        pairs: (upper, lower): the lower one carries, contains or is leant on by the upper one.
        standing: Of each part, whether the table alone carries it.
    """

    pairs: frozenset[tuple[int, int]]
    standing: tuple[bool, ...]


def read_support(parts: Sequence[Part], contact_m: float) -> Support:
    """Support from heights, contact, footprints and where the centre of mass lies; containment as given.

    Of two that are near one another, one carries the other if that one's centre of mass is above its footprint; and
    whatever could not stand as it does leans on all that it nearly touches and that stands, or lies lower.
    """
    needy = [_needs_support(part) for part in parts]
    outlines = [_outline(part.body.solids.points[:, :2]) for part in parts]
    given = _given(parts)
    pairs = set(given)
    for i, j in combinations(range(len(parts)), 2):
        if {(i, j), (j, i)} & given or not are_within(parts[i].body, parts[j].body, contact_m):
            continue
        above = _carried_pair(parts, outlines, needy, i, j) or _leaning_pair(parts, needy, i, j)
        if above is not None:
            pairs.add(above)
    uppers = {upper for upper, _ in pairs}
    return Support(frozenset(pairs), tuple(i not in uppers for i in range(len(parts))))


def _given(parts: Sequence[Part]) -> set[tuple[int, int]]:
    index = {part.object_id: i for i, part in enumerate(parts)}
    held = [(i, index.get(part.container_id or "", i)) for i, part in enumerate(parts)]
    return {(i, j) for i, j in held if i != j and (j, i) not in held}


def _carried_pair(
    parts: Sequence[Part], outlines: Sequence[Outline], needy: Sequence[bool], i: int, j: int
) -> tuple[int, int] | None:
    i_over, j_over = _is_over(parts[i], outlines[j]), _is_over(parts[j], outlines[i])
    if not (i_over or j_over):
        return None
    if needy[i] != needy[j]:
        i_above = needy[i]
    elif i_over != j_over:
        i_above = i_over
    else:
        i_above = bool(parts[i].mass_center[2] > parts[j].mass_center[2])
    if i_above:
        return (i, j) if i_over else None
    return (j, i) if j_over else None


def _leaning_pair(parts: Sequence[Part], needy: Sequence[bool], i: int, j: int) -> tuple[int, int] | None:
    if not (needy[i] or needy[j]):
        return None
    i_above = needy[i] if needy[i] != needy[j] else bool(parts[i].mass_center[2] > parts[j].mass_center[2])
    return (i, j) if i_above else (j, i)


def _is_over(part: Part, outline: Outline) -> bool:
    return bool((outline[:, :2] @ part.mass_center[:2] + outline[:, 2] <= 0.0).all())


def _needs_support(part: Part) -> bool:
    """Whether the table alone cannot carry the part as it stands, give or take the noise of its pose."""
    if part.lowest_m > ON_TABLE_M:
        return True
    around = part.body.solids.points - part.mass_center
    heights = (around @ _WITHIN_NOISE.T).max(axis=0)
    beyond = (around @ _BEYOND_NOISE.T).max(axis=0)
    return bool(beyond.min() < heights.min() - BASIN_TOLERANCE_M)


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
