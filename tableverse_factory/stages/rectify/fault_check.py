"""Detection of faultless layouts, which rectification leaves unchanged."""

from collections.abc import Sequence
from itertools import combinations, compress

from tableverse_factory.geometry.collision.linear_sweep import MIN_MARGIN_M, TOLERANCE_M, LinearSweep, are_within
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.vertical import UP

MAX_SUNK_M = 1e-6  # A part below the table by no more than this stands on it [m]
MAX_HOVER_M = 1e-3  # A part that would sink by no more than this lies still [m]

# Reductions of the clearance: to lower parts past others, to find parts too near, and to test whether a part would
# sink. In this order, the last two further apart than the tolerance: then no lowered part is too near, and no permitted
# neighbour holds a part by its side.
LET_DOWN_M, NEAR_M, PAST_M = 4 * TOLERANCE_M, 5 * TOLERANCE_M, 7 * TOLERANCE_M

ROUND_M = 2e-3  # A round part's lowest corner lies below its centre of mass, to within this [m]


def is_faultless(parts: Sequence[RigidPart], clearance_m: float) -> bool:
    """Whether no two parts are nearer than the clearance, nothing is below the table, and everything lies.

    A part lies if it would sink by no more than `MAX_HOVER_M` until it meets the table or a lying part, and stands
    upright or is within the same distance of a lying part.
    """
    if any(part.lowest_now_m < -MAX_SUNK_M for part in parts):
        return False
    if any(are_near(a, b, clearance_m - NEAR_M) for a, b in combinations(parts, 2)):
        return False
    lying: list[RigidPart] = []
    waiting = list(parts)
    while waiting:
        held = [_lies(part, lying, clearance_m) for part in waiting]
        if not any(held):
            return False
        lying += compress(waiting, held)
        waiting = [part for part, lies in zip(waiting, held, strict=True) if not lies]
    return True


def are_near(a: RigidPart, b: RigidPart, reach_m: float) -> bool:
    """Whether two parts come within a reach, enlarged by what either mesh sticks out of its pieces."""
    return are_within(a.body, b.body, max(reach_m + a.body.uncovered_m + b.body.uncovered_m, MIN_MARGIN_M / 2))


def _lies(part: RigidPart, lying: Sequence[RigidPart], clearance_m: float) -> bool:
    if part.lowest_now_m > MAX_HOVER_M:
        bodies = [other.body for other in lying]  # at a smaller clearance, so that close neighbours do not hold it
        if LinearSweep(-UP).room([part.body], bodies, clearance_m - PAST_M, part.lowest_now_m) > MAX_HOVER_M:
            return False
    return _is_upright(part) or any(are_near(part, other, clearance_m + MAX_HOVER_M) for other in lying)


def _is_upright(part: RigidPart) -> bool:
    """Whether the centre of mass is above the box around the lowest points."""
    points = part.body.solids.points
    base = points[points[:, 2] <= points[:, 2].min() + MAX_HOVER_M, :2]
    center = part.mass_center[:2]
    return bool((base.min(axis=0) - ROUND_M <= center).all() and (center <= base.max(axis=0) + ROUND_M).all())
