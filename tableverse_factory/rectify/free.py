"""Layouts that have no fault: neither method touches them."""

from collections.abc import Sequence
from itertools import combinations

from tableverse_factory.geometry.clearance import LEAST_MARGIN_M, TOLERANCE_M, Ray, are_within
from tableverse_factory.rectify.parts import Part
from tableverse_factory.rectify.vertical import UP

BELOW_M = 1e-6
"""What is below the table by no more than this stands on it [m]."""
HOVER_M = 1e-3
"""What would sink by no more than this if it were let down lies where it is [m]."""


def is_faultless(parts: Sequence[Part], clearance_m: float) -> bool:
    """Whether no two parts are nearer than the clearance, nothing is below the table, and everything lies.

    A part lies if it would sink by no more than `HOVER_M` until it meets the table or a part that lies.
    """
    if any(part.lowest_now_m < -BELOW_M for part in parts):
        return False
    if any(_too_near(a, b, clearance_m) for a, b in combinations(parts, 2)):
        return False
    return _all_lie(parts, clearance_m)


def _all_lie(parts: Sequence[Part], clearance_m: float) -> bool:
    lying = [part for part in parts if part.lowest_now_m <= HOVER_M]
    waiting = [part for part in parts if part.lowest_now_m > HOVER_M]
    while waiting:
        held = [_sinks_m(part, lying, clearance_m) <= HOVER_M for part in waiting]
        if not any(held):
            return False
        lying += [part for part, lies in zip(waiting, held, strict=True) if lies]
        waiting = [part for part, lies in zip(waiting, held, strict=True) if not lies]
    return True


def _sinks_m(part: Part, lying: Sequence[Part], clearance_m: float) -> float:
    """How far a part would sink [m]; by a slightly smaller clearance, so that what stands close beside is no hold."""
    return Ray(-UP).room([part.body], [other.body for other in lying], clearance_m - 4 * TOLERANCE_M, part.lowest_now_m)


def _too_near(a: Part, b: Part, clearance_m: float) -> bool:
    margin = max(clearance_m + a.body.uncovered_m + b.body.uncovered_m, LEAST_MARGIN_M)
    return are_within(a.body, b.body, margin - 2 * TOLERANCE_M)
