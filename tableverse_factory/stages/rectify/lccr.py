"""Layout-consistent collision rectification: the paper's three phases (section 3.2), ending free of everything."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import RectifyConfig
from tableverse_factory.stages.rectify.fault_check import is_faultless
from tableverse_factory.stages.rectify.groups import Group, entities, ground, group, lowest_of
from tableverse_factory.stages.rectify.radial import radial_order, spread
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.vertical import disentangle, fill

Spread = Callable[[Sequence[RigidPart], Sequence[Group], float], list[RigidPart]]
"""Phase 2: parts, ordered groups and clearance [m] to moved parts."""

HANGING_M = 1e-9
"""A group whose lowest vertex is higher than this hangs in the air."""


@dataclass(frozen=True, slots=True, eq=False)
class Rectified:
    """The outcome of a rectification.

    Attributes:
        parts: As given, moved; same order.
        groups: Indices into `parts`; the root first, then in the order of their distance from it.
        method: What it took: `lccr`, `joint`, or `partly radial` and `radial` where no joint least motion was found.
    """

    parts: tuple[RigidPart, ...]
    groups: tuple[Group, ...]
    method: str = "lccr"


def lccr(parts: Sequence[RigidPart], config: RectifyConfig, spread: Spread = spread) -> Rectified:
    """Moves parts until none is nearer to another than the clearance.

    The result depends on ids and geometry, not on the order of `parts`. A layout without a fault is left alone.

    Args:
        parts: The objects.
        config: Of the stage.
        spread: How the groups are spread; the exact solution unless somebody compares.
    """
    order = sorted(range(len(parts)), key=lambda i: parts[i].object_id)
    given = [parts[i] for i in order]
    composites = entities(given)
    faultless = is_faultless(given, config.clearance_m)
    filled = given if faultless else fill(given, composites, config.clearance_m)
    groups = group(filled, composites, config.overlap_ratio, config.contact_m)
    ordered = radial_order(filled, groups)
    free = filled if faultless else _apart(filled, ordered, config.clearance_m, spread)
    back = {i: k for k, i in enumerate(order)}
    return Rectified(
        tuple(free[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in members) for members in ordered),
    )


def _apart(parts: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float, spread: Spread) -> list[RigidPart]:
    """Groups put on the table, spread, and freed within."""
    return stacked_free(spread(ground(parts, ordered), ordered, clearance_m), ordered, clearance_m)


def stacked_free(apart: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float) -> list[RigidPart]:
    """Phase 3, and what the paper leaves open.

    A part may rise into the overhang of another group, or leave its own group hanging where it was the lowest.
    Two ways out, each of which ends free of everything: put the groups down and spread them once more with their final
    shapes, or lift the part further, clear of all groups. The one that moves the parts less in sum is taken, as long
    as every group stands on the table. Where none of this happens both are phase 3 as it stands.
    """
    outward = spread(ground(disentangle(apart, ordered, clearance_m), ordered), ordered, clearance_m)
    upward = disentangle(apart, ordered, clearance_m, against_all=True)
    if max(lowest_of(upward, group) for group in ordered) > HANGING_M:
        return outward
    return min(outward, upward, key=lambda parts: _total_motion(parts, apart))


def _total_motion(parts: Sequence[RigidPart], before: Sequence[RigidPart]) -> float:
    return sum(
        float(np.linalg.norm(part.body.offset - old.body.offset)) for part, old in zip(parts, before, strict=True)
    )
