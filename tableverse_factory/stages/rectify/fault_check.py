"""Layouts that have no fault: neither method touches them."""

from collections.abc import Sequence
from itertools import combinations

from tableverse_factory.geometry.collision.ray_clearance import LEAST_MARGIN_M, TOLERANCE_M, Ray, are_within
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.vertical import UP

BELOW_M = 1e-6
"""What is below the table by no more than this stands on it [m]."""
HOVER_M = 1e-3
"""What would sink by no more than this if it were let down lies where it is [m]."""

LET_DOWN_M, NEAR_M, PAST_M = 4 * TOLERANCE_M, 5 * TOLERANCE_M, 7 * TOLERANCE_M
"""Less than the clearance by so much: how near things are let down past others, how near is too near, and how near a
thing may come to others where it is asked whether it would sink. In this order, the last two further apart than the
tolerance: then nothing that was let down is too near, and no neighbour that is not too near holds a thing by its side.
"""

ROUND_M = 2e-3
"""A round thing's lowest corner is about below its centre of mass, to within this [m]."""


def is_faultless(parts: Sequence[RigidPart], clearance_m: float) -> bool:
    """Whether no two parts are nearer than the clearance, nothing is below the table, and everything lies.

    A part lies if it would sink by no more than `HOVER_M` until it meets the table or a part that lies, and stands as
    it is turned or is no further from a part that lies.
    """
    if any(part.lowest_now_m < -BELOW_M for part in parts):
        return False
    if any(are_near(a, b, clearance_m - NEAR_M) for a, b in combinations(parts, 2)):
        return False
    return _all_lie(parts, clearance_m)


def are_near(a: RigidPart, b: RigidPart, reach_m: float) -> bool:
    """Whether two parts come within a reach, and what either mesh sticks out of its pieces, of one another."""
    return are_within(a.body, b.body, max(reach_m + a.body.uncovered_m + b.body.uncovered_m, LEAST_MARGIN_M / 2))


def _all_lie(parts: Sequence[RigidPart], clearance_m: float) -> bool:
    lying: list[RigidPart] = []
    waiting = list(parts)
    while waiting:
        held = [_lies(part, lying, clearance_m) for part in waiting]
        if not any(held):
            return False
        lying += [part for part, lies in zip(waiting, held, strict=True) if lies]
        waiting = [part for part, lies in zip(waiting, held, strict=True) if not lies]
    return True


def _lies(part: RigidPart, lying: Sequence[RigidPart], clearance_m: float) -> bool:
    if part.lowest_now_m > HOVER_M and _sinks_m(part, lying, clearance_m) > HOVER_M:
        return False
    return _is_upright(part) or any(are_near(part, other, clearance_m + HOVER_M) for other in lying)


def _is_upright(part: RigidPart) -> bool:
    """Whether the centre of mass is above the box around the lowest points."""
    points = part.body.solids.points
    base = points[points[:, 2] <= points[:, 2].min() + HOVER_M, :2]
    center = part.mass_center[:2]
    return bool((base.min(axis=0) - ROUND_M <= center).all() and (center <= base.max(axis=0) + ROUND_M).all())


def _sinks_m(part: RigidPart, lying: Sequence[RigidPart], clearance_m: float) -> float:
    """How far a part would sink [m]; by a slightly smaller clearance, so that what stands close beside is no hold."""
    return Ray(-UP).room([part.body], [other.body for other in lying], clearance_m - PAST_M, part.lowest_now_m)
