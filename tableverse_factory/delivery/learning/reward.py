"""A dense reward that cannot be farmed: differences of one number that says how far things have come.

Whatever a policy does on the way, its differences add up to at most 1, and what it gains by coming near it loses by
going away (potential-based shaping: Ng, Harada and Russell, 1999).
"""

import numpy as np

from schemas.curation import Relation
from schemas.geometry import Vector3
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS

_SIDES = {Relation.LEFT: (-1, 0), Relation.RIGHT: (1, 0), Relation.IN_FRONT: (0, -1), Relation.BEHIND: (0, 1)}
_GAP_M = 0.05
"""Between the boxes, where one is to stand beside the other."""

_STEEPNESS = 5.0
"""Per metre: what is 0.2 m away counts a quarter."""


def progress(lifted: bool, fingers: int, reach_m: float, way_m: float) -> float:
    """From 0 to 1: reaching for the object, both fingers on it, and, once it was up, the way to its place.

    Args:
        lifted: Whether the object was up and in the fingers at some time.
        fingers: How many touch it now.
        reach_m: From between the fingertips to the object's centre of mass [m].
        way_m: As `way_to_place` [m].
    """
    if lifted:
        return 0.5 + 0.5 * _near(way_m)
    return 0.3 * _near(reach_m) + 0.1 * fingers


def way_to_place(relation: Relation, x: Vector3, y: Vector3, x_half: Vector3, y_half: Vector3) -> float:
    """How far the object has to go horizontally until the relation may hold [m].

    Args:
        relation: That is to hold.
        x: Centre of the object [m].
        y: Middle of the reference's box [m].
        x_half: Half the size of the object's box as it stood [m].
        y_half: The same of the reference [m].
    """
    away = (x - y)[:2]
    if relation in RESTING_RELATIONS:
        return float(np.linalg.norm(away))
    reach = x_half[:2] + y_half[:2] + _GAP_M
    if relation in _SIDES:
        return float(np.linalg.norm(np.array(_SIDES[relation]) * reach - away))
    beyond = float(np.max(np.abs(away) - reach))
    return max(beyond, 0.0) if relation is Relation.NEXT_TO else max(-beyond, 0.0)


def _near(distance_m: float) -> float:
    return 1.0 - float(np.tanh(_STEEPNESS * distance_m))
