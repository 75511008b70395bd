"""Joint rectification: the whole layout moves as little as possible and keeps its support relations."""

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.config import RectifyConfig
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep
from tableverse_factory.stages.rectify.fault_check import LET_DOWN_M, is_faultless
from tableverse_factory.stages.rectify.groups import Group, connect_components, form_entities, ground_groups
from tableverse_factory.stages.rectify.lccr import RectificationResult
from tableverse_factory.stages.rectify.leaning import relax_and_find_leaning
from tableverse_factory.stages.rectify.quarter_turn_symmetry import (
    apply_motion,
    count_quarter_turns,
    rotate_about_origin,
)
from tableverse_factory.stages.rectify.radial import compute_azimuths, order_radially, spread_groups
from tableverse_factory.stages.rectify.rigid_part import RigidPart, follow_body, merge_rigid_parts
from tableverse_factory.stages.rectify.support import SupportRelation, read_support
from tableverse_factory.stages.rectify.vertical import UP, lift_contents, lift_in_turn

Azimuths = Float64[np.ndarray, " n"]

AT_REST_M = 1e-6  # lowering ends with a motion smaller than this [m]
MAX_NOISE_M = 0.025  # where no part moves further, noise explains it, and the radial method is not tried [m]
SAME_WAY_RAD = 1e-4  # azimuths that differ by less are equal, so that rounding errors do not order a row [rad]


def rectify_jointly(parts: Sequence[RigidPart], config: RectifyConfig) -> RectificationResult:
    """Move parts together, as little as possible, until none is nearer to another than the clearance.

    A composite moves as one. The result depends on ids and geometry, not on the order of `parts`. A faultless layout
    is left unchanged.
    """
    if not parts:
        return RectificationResult((), (), "joint")
    order = sorted(range(len(parts)), key=lambda i: parts[i].object_id)
    given = [parts[i] for i in order]
    composites = form_entities(given)
    faultless = is_faultless(given, config.clearance_m)
    filled = given if faultless else lift_contents(given, composites, config.clearance_m)
    bodies = [merge_rigid_parts([filled[i] for i in entity]) for entity in composites]
    quarters = count_quarter_turns(bodies)
    likenesses = [rotate_about_origin(body, quarters) for body in bodies]
    ends, ordered, method = _rectify_bodies(likenesses, config, faultless)
    moved = [apply_motion(*three, quarters) for three in zip(bodies, likenesses, ends, strict=True)]
    where = {i: k for k, entity in enumerate(composites) for i in entity}
    if not faultless:
        filled = [follow_body(part, bodies[where[i]], moved[where[i]]) for i, part in enumerate(filled)]
    groups = [tuple(composites[k] for (k,) in group) for group in ordered]
    back = {i: k for k, i in enumerate(order)}
    return RectificationResult(
        tuple(filled[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in group) for group in groups),
        method,
    )


def _rectify_bodies(
    bodies: Sequence[RigidPart], config: RectifyConfig, faultless: bool
) -> tuple[list[RigidPart], list[Group], str]:
    """Rectify rigid bodies; returns them, the support trees in radial order, and the method.

    A cluster whose least motion is too much work, or has no solution, moves straight outward as in the paper, which
    always ends and keeps the order ("partly radial"). So does the whole layout ("radial") where the order of the trees
    around the most central one would change, or where that moves less.
    """
    clearance = config.clearance_m
    relaxed = None if faultless else relax_and_find_leaning(bodies, config)
    support = read_support(bodies, config.contact_m) if relaxed is None else relaxed.support
    trees = connect_components(sorted(support.pairs), len(bodies))
    ordered = order_radially(bodies, [tuple((i,) for i in tree) for tree in trees])
    if relaxed is None:
        return list(bodies), ordered, "joint"
    unsolved = len(relaxed.unsolved)
    method = "radial" if unsolved == len(bodies) else "partly radial" if unsolved else "joint"
    moved = _remove_overlaps(relaxed.parts, support, ordered, clearance)
    kept = is_order_kept(compute_azimuths(bodies, ordered), compute_azimuths(moved, ordered))
    ways = _measure_distances(bodies, moved)
    if kept and ways.max() <= MAX_NOISE_M:
        return moved, ordered, method
    outward = _remove_overlaps(bodies, support, ordered, clearance)
    if kept and (ways**2).sum() <= (_measure_distances(bodies, outward) ** 2).sum():
        return moved, ordered, method
    return outward, ordered, "radial"


def is_order_kept(before: Azimuths, after: Azimuths) -> bool:
    """Whether objects at these azimuths about one point keep their counter-clockwise order.

    Those within `SAME_WAY_RAD` had no order among themselves; NaN, for objects in that point, is ignored.
    """
    known = ~(np.isnan(before) | np.isnan(after))
    around, ended = np.sort(before[known]), after[known][np.argsort(before[known], kind="stable")]
    if len(ended) < 2:
        return True
    first = int(np.argmax(_compute_turns(around))) + 1
    around, ended = np.roll(around, -first), np.roll(ended, -first)
    ways = np.cumsum(np.concatenate([[False], _compute_turns(around)[:-1] > SAME_WAY_RAD]))
    for way in np.unique(ways):
        mine = np.flatnonzero(ways == way)
        away = np.mod(ended[mine] - ended[mine[0]] + np.pi, 2 * np.pi) - np.pi
        ended[mine] = ended[mine][np.argsort(away, kind="stable")]
    return bool(_compute_turns(ended).sum() < 3 * np.pi)


def _compute_turns(angles: Azimuths) -> Azimuths:
    """Compute counter-clockwise turns from each angle to the next, cyclically; a hair clockwise is none [rad]."""
    steps = np.diff(angles, append=angles[:1])
    return np.maximum(np.mod(steps + SAME_WAY_RAD, 2 * np.pi) - SAME_WAY_RAD, 0.0)


def _measure_distances(before: Sequence[RigidPart], after: Sequence[RigidPart]) -> Float64[np.ndarray, " n"]:
    """Measure how far each part has been moved [m]."""
    ways = np.array([b.body.offset - a.body.offset for a, b in zip(before, after, strict=True)])
    return np.linalg.norm(ways, axis=1)


def _remove_overlaps(
    parts: Sequence[RigidPart], support: SupportRelation, ordered: Sequence[Group], clearance_m: float
) -> list[RigidPart]:
    """Remove remaining overlaps exactly: upward within a tree, outward between trees; then lower all parts."""
    raised, order = list(parts), order_upward(parts, support)
    for group in ordered:
        lift_in_turn(raised, [(i,) for i in order if (i,) in group], [], clearance_m)
    return _lower_parts(spread_groups(ground_groups(raised, ordered), ordered, clearance_m), support, clearance_m)


def _lower_parts(parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float) -> list[RigidPart]:
    """Lower each part, carriers first, onto the table or another part, until none sinks any more.

    That takes several rounds where one lowered late has carried one lowered early.
    """
    ray, lowered = LinearSweep(-UP), list(parts)
    for _ in parts:
        before = list(lowered)
        for i in order_upward(before, support):
            others = [part.body for k, part in enumerate(lowered) if k != i]
            depth = ray.room([lowered[i].body], others, clearance_m - LET_DOWN_M, lowered[i].lowest_now_m)
            lowered[i] = lowered[i].moved(-depth * UP)
        if _measure_distances(before, lowered).max() < AT_REST_M:
            break
    return lowered


def order_upward(parts: Sequence[RigidPart], support: SupportRelation) -> list[int]:
    """Order indices with carriers before the parts they carry, as far as there is no cycle; then by height and id."""
    rank = sorted(range(len(parts)), key=lambda i: (not support.standing[i], parts[i].lowest_now_m, parts[i].object_id))
    missing = Counter(up for up, _ in support.pairs)
    carried = defaultdict(list)
    for up, low in support.pairs:
        carried[low].append(up)
    done: list[int] = []
    while rank:
        done.append(next((i for i in rank if not missing[i]), rank[0]))
        rank.remove(done[-1])
        missing.subtract(carried[done[-1]])
    return done
