"""Support that only the motion shows: objects that move less if they lean on a neighbour than if they stand."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Float64

from schemas.config import RectifyConfig
from schemas.geometry import Frozen
from tableverse_factory.geometry.collision.linear_sweep import are_within
from tableverse_factory.geometry.math.transforms import conjugate_quaternion, multiply_quaternions
from tableverse_factory.stages.rectify.levelling import stand_on_table
from tableverse_factory.stages.rectify.relaxation import NOISE, Effort, make_effort, relax_layout
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import SupportRelation, measure_vertical_gap, read_support

# A part leans where that lowers the squared motion of all, in units of the noise, by this much: less is noise.
GAIN = 5.0
MAX_VERTICAL_GAP_M = 0.016  # to what it leans on: more, and it was seen to stand beside it [m]
TOUCHING_M = 0.0015  # beyond the clearance; a part that could sink further touches the other's side alone [m]
MAX_TRIALS = 6  # further relaxations of a layout, all within the budget of one


@dataclass(frozen=True, slots=True, eq=False)
class RelaxedLayout(Frozen):
    """Parts after their least motion, those of `unsolved` clusters as they were seen.

    `costs` are the squared motions of each part, in multiples of `NOISE`; 0 for an unsolved one.
    """

    support: SupportRelation
    parts: list[RigidPart]
    unsolved: set[int]
    costs: Float64[np.ndarray, " n"]


def relax_and_find_leaning(seen: Sequence[RigidPart], config: RectifyConfig) -> RelaxedLayout:
    """Relax a layout; where a standing part moves far, let it lean on a near one instead, and keep what costs less.

    A small tilt is noise of a part that stands, or is seen of one that leans: the motion of all decides. A part that
    carries another stays: it may move far because of what lies on it.
    """
    effort, trials = make_effort(), 0
    best = _relax(seen, read_support(seen, config.contact_m), config, effort)
    for upper, lower in _list_suspects(seen, best, config):
        if not best.support.standing[upper] or any(upper in pair for pair in best.support.pairs):
            continue  # it leans on another already, or another on it
        if trials == MAX_TRIALS:
            break
        trials += 1
        tried = _relax(seen, best.support.adding(upper, lower), config, effort)
        if not tried.unsolved <= best.unsolved:
            continue  # what stays as it was seen has not moved, which proves nothing
        lies = measure_vertical_gap(tried.parts[upper], tried.parts[lower]) <= config.clearance_m + TOUCHING_M
        if lies and tried.costs.sum() < best.costs.sum() - GAIN:
            best = tried
    return best


def _relax(seen: Sequence[RigidPart], support: SupportRelation, config: RectifyConfig, effort: Effort) -> RelaxedLayout:
    """Level the standing parts, and find the least motion of all."""
    upright = [
        stand_on_table(part) if standing else part for part, standing in zip(seen, support.standing, strict=True)
    ]
    near, unsolved = relax_layout(upright, support, config.clearance_m, effort)
    parts = [seen[i] if i in unsolved else part for i, part in enumerate(near)]
    costs = [_measure_cost(before, after) for before, after in zip(seen, parts, strict=True)]
    return RelaxedLayout(support, parts, unsolved, np.array(costs))


def _measure_cost(before: RigidPart, after: RigidPart) -> float:
    """Measure the squared motion of a part, in units of the noise."""
    turn = multiply_quaternions(after.turned_by, conjugate_quaternion(before.turned_by))
    rotation = 2.0 * np.copysign(1.0, turn[0]) * turn[1:]
    motion = np.concatenate([after.mass_center_now - before.mass_center_now, rotation]) / NOISE
    return float(motion @ motion)


def _list_suspects(seen: Sequence[RigidPart], relaxed: RelaxedLayout, config: RectifyConfig) -> list[tuple[int, int]]:
    """List standing parts that move far, the furthest first, with the near ones upon which they may lie."""
    costs, support = relaxed.costs, relaxed.support
    pairs = [
        (i, j)
        for i, j in permutations(range(len(seen)), 2)
        if support.standing[i]
        and costs[i] >= GAIN
        and are_within(seen[i].body, seen[j].body, config.contact_m)
        and measure_vertical_gap(seen[i], seen[j]) <= MAX_VERTICAL_GAP_M
    ]
    return sorted(pairs, key=lambda pair: (-costs[pair[0]], *(seen[i].object_id for i in pair)))
