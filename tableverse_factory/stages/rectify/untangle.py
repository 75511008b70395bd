"""Out of an entanglement: where planes contradict one another, one of two parts goes the least way that frees it."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Points, Vector3
from tableverse_factory.geometry.collision.ray_clearance import Ray
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import SupportRelation
from tableverse_factory.stages.rectify.vertical import UP

AZIMUTHS = 16
UPWARD_COST = 1.5
"""A way up counts this much more than a way aside: what rises leaves what carries it."""


def released(
    parts: Sequence[RigidPart], support: SupportRelation, stuck: Sequence[tuple[int, int]], clearance_m: float
) -> list[RigidPart]:
    """Parts such that no pair of `stuck` is nearer than the clearance, nor a part that was moved to any other.

    For one pair after the other the part that gets free of everything on the shortest way takes it; what stands on the
    table goes aside only.
    """
    freed = list(parts)
    for pair in stuck:
        ways = [(cost, k, way) for k in pair for cost, way in _ways_out(freed, k, support, clearance_m)]
        _, k, way = min(ways, key=lambda found: (found[0], freed[found[1]].object_id))
        freed[k] = freed[k].moved(way)
    return freed


def _ways_out(
    parts: Sequence[RigidPart], k: int, support: SupportRelation, clearance_m: float
) -> list[tuple[float, Vector3]]:
    others = [part.body for i, part in enumerate(parts) if i != k]
    ways = []
    for direction in _directions(parts[k], support.standing[k]):
        distance = Ray(direction).first_clear([parts[k].body], others, clearance_m)
        ways.append((distance * (UPWARD_COST if direction[2] > 0.0 else 1.0), distance * direction))
    return ways


def _directions(part: RigidPart, standing: bool) -> Points:
    """Evenly around from the part's own heading, so that they turn with the layout; and up."""
    angle = np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS + np.arctan2(part.heading[1], part.heading[0])
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(AZIMUTHS)])
    return around if standing else np.vstack([around, UP])
