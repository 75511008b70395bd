"""Release entangled parts: where separating planes contradict, one of two parts moves the least way that frees it."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import SupportRelation
from tableverse_factory.stages.rectify.vertical import UP

AZIMUTHS = 16
UPWARD_COST = 1.5  # cost of a way up against a way aside, as a rising part leaves its carrier


def release_parts(
    parts: Sequence[RigidPart], support: SupportRelation, stuck: Sequence[tuple[int, int]], clearance_m: float
) -> list[RigidPart]:
    """Separate each pair of `stuck` in turn: the part with the shortest way clear of all others takes it.

    Standing parts only move aside.
    """
    freed = list(parts)
    for pair in stuck:
        ways = [(cost, k, way) for k in pair for cost, way in _list_ways_out(freed, k, support, clearance_m)]
        _, k, way = min(ways, key=lambda found: (found[0], freed[found[1]].object_id))
        freed[k] = freed[k].moved(way)
    return freed


def _list_ways_out(
    parts: Sequence[RigidPart], k: int, support: SupportRelation, clearance_m: float
) -> list[tuple[float, Vector3]]:
    """List the ways evenly around from the part's own heading, and up for one that does not stand, with their costs."""
    part, others = parts[k], [other.body for i, other in enumerate(parts) if i != k]
    angle = np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS + np.arctan2(part.heading[1], part.heading[0])
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(AZIMUTHS)])
    ways = []
    for direction in around if support.standing[k] else np.vstack([around, UP]):
        distance = LinearSweep(direction).find_first_clear([part.body], others, clearance_m)
        ways.append((distance * (UPWARD_COST if direction[2] > 0.0 else 1.0), distance * direction))
    return ways
