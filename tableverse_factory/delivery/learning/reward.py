"""Dense reward as differences of a progress measure.

The differences add up to at most 1 over any path, and approaching gains what retreating loses (potential-based shaping:
Ng, Harada and Russell, 1999).
"""

import numpy as np

from schemas.curation import Relation
from schemas.geometry import Vector3
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS

_SIDES = {Relation.LEFT: (-1, 0), Relation.RIGHT: (1, 0), Relation.IN_FRONT: (0, -1), Relation.BEHIND: (0, 1)}
_GAP_M = 0.05  # gap between the boxes of objects that stand beside each other
_STEEPNESS = 5.0  # per meter: a distance of 0.2 m counts a quarter


def compute_progress(lifted: bool, fingers: int, reach_m: float, way_m: float) -> float:
    """Compute progress from 0 to 1: reaching, both fingers touching, and, once lifted, the way to the goal.

    `reach_m` is from the TCP to the object's center of mass, `way_m` as `compute_goal_distance`.
    """
    if lifted:
        return 0.5 + 0.5 * _compute_proximity(way_m)
    return 0.3 * _compute_proximity(reach_m) + 0.1 * fingers


def compute_goal_distance(relation: Relation, x: Vector3, y: Vector3, x_half: Vector3, y_half: Vector3) -> float:
    """Compute the horizontal distance until the relation may hold [m].

    `x` is the object's center, `y` the middle of the reference's box; half sizes are of their initial boxes [m].
    """
    away = (x - y)[:2]
    if relation in RESTING_RELATIONS:
        return float(np.linalg.norm(away))
    reach = x_half[:2] + y_half[:2] + _GAP_M
    if relation in _SIDES:
        return float(np.linalg.norm(np.array(_SIDES[relation]) * reach - away))
    beyond = float(np.max(np.abs(away) - reach))
    return max(beyond, 0.0) if relation is Relation.NEXT_TO else max(-beyond, 0.0)


def _compute_proximity(distance_m: float) -> float:
    return 1.0 - float(np.tanh(_STEEPNESS * distance_m))
