"""Layout-consistent collision rectification: the paper's three phases (section 3.2), ending collision-free."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import RectifyConfig
from tableverse_factory.stages.rectify.fault_check import is_faultless
from tableverse_factory.stages.rectify.groups import Group, form_entities, form_groups, ground_groups, measure_lowest_m
from tableverse_factory.stages.rectify.radial import order_radially, spread_groups
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.vertical import disentangle, lift_contents

# Phase 2: parts, ordered groups and clearance [m] to moved parts.
SpreadFunction = Callable[[Sequence[RigidPart], Sequence[Group], float], list[RigidPart]]

HANGING_M = 1e-9  # A group whose lowest vertex is higher than this hangs in the air


@dataclass(frozen=True, slots=True, eq=False)
class RectificationResult:
    """Moved parts, in the order in which they were given, and how they were moved.

    Attributes:
        groups: Indices into `parts`; the root first, then in the order of their distance from it.
        method: `lccr`, `joint`, or `partly radial` and `radial` where no joint least motion was found.
    """

    parts: tuple[RigidPart, ...]
    groups: tuple[Group, ...]
    method: str = "lccr"


def rectify_lccr(
    parts: Sequence[RigidPart], config: RectifyConfig, spread: SpreadFunction = spread_groups
) -> RectificationResult:
    """Move parts until none is nearer to another than the clearance, with the exact solution of phase 2 by default.

    The result depends on ids and geometry, not on the order of `parts`. A faultless layout is left unchanged.
    """
    order = sorted(range(len(parts)), key=lambda i: parts[i].object_id)
    given = [parts[i] for i in order]
    composites = form_entities(given)
    faultless = is_faultless(given, config.clearance_m)
    filled = given if faultless else lift_contents(given, composites, config.clearance_m)
    groups = form_groups(filled, composites, config.overlap_ratio, config.contact_m)
    ordered = order_radially(filled, groups)
    if not faultless:
        apart = spread(ground_groups(filled, ordered), ordered, config.clearance_m)
        filled = separate_stacks(apart, ordered, config.clearance_m)
    back = {i: k for k, i in enumerate(order)}
    return RectificationResult(
        tuple(filled[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in members) for members in ordered),
    )


def separate_stacks(apart: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float) -> list[RigidPart]:
    """Run phase 3, and resolve two cases that the paper leaves open.

    A part may rise into the overhang of another group, or leave its own group hanging where it was the lowest. Either
    the groups are put down and spread once more with their final shapes, or the part is lifted further, clear of all
    groups. The one that moves the parts less in sum is taken, as long as every group stands on the table. Otherwise
    both equal phase 3.
    """
    outward = spread_groups(ground_groups(disentangle(apart, ordered, clearance_m), ordered), ordered, clearance_m)
    upward = disentangle(apart, ordered, clearance_m, against_all=True)
    if max(measure_lowest_m(upward, group) for group in ordered) > HANGING_M:
        return outward
    return min(outward, upward, key=lambda parts: _sum_motion(parts, apart))


def _sum_motion(parts: Sequence[RigidPart], before: Sequence[RigidPart]) -> float:
    return sum(
        float(np.linalg.norm(part.body.offset - old.body.offset)) for part, old in zip(parts, before, strict=True)
    )
