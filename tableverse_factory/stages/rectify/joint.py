"""Joint rectification: the whole layout moves as little as it can, and who carries whom stays."""

from collections import Counter, defaultdict
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.config import RectifyConfig
from tableverse_factory.geometry.collision.ray_clearance import Ray
from tableverse_factory.stages.rectify.clusters import Relaxed, relaxed
from tableverse_factory.stages.rectify.fault_check import LET_DOWN_M, is_faultless
from tableverse_factory.stages.rectify.groups import Group, components, entities, ground
from tableverse_factory.stages.rectify.lccr import Rectified
from tableverse_factory.stages.rectify.levelling import levelled
from tableverse_factory.stages.rectify.quarter_turn_symmetry import quarters_of, taken_over, turned_about_origin
from tableverse_factory.stages.rectify.radial import azimuths, radial_order, spread
from tableverse_factory.stages.rectify.rigid_part import RigidPart, carried_along, merged
from tableverse_factory.stages.rectify.support import SupportRelation, read_support
from tableverse_factory.stages.rectify.vertical import UP, fill

Azimuths = Float64[np.ndarray, " n"]

AT_REST_M = 1e-6
"""What is let down by less than this has arrived [m]."""
FAR_M = 0.025
"""Where nothing goes further, noise explains it, and no other way is looked for [m]."""
SAME_WAY_RAD = 1e-4
"""Azimuths that differ by less are one: in a row of objects, rounding errors shall not decide [rad]."""
MOST_TILT_RAD = np.radians(4.0)
"""What stands is levelled by at most this; more is no noise."""


def joint(parts: Sequence[RigidPart], config: RectifyConfig) -> Rectified:
    """Moves parts until none is nearer to another than the clearance, all of them together and as little as possible.

    A composite moves as one. The result depends on ids and geometry, not on the order of `parts`. A layout without a
    fault is left alone, and so is one without parts.
    """
    if not parts:
        return Rectified((), (), "joint")
    order = sorted(range(len(parts)), key=lambda i: parts[i].object_id)
    given = [parts[i] for i in order]
    composites = entities(given)
    faultless = is_faultless(given, config.clearance_m)
    filled = given if faultless else fill(given, composites, config.clearance_m)
    bodies = [merged([filled[i] for i in entity]) for entity in composites]
    quarters = quarters_of(bodies)
    likenesses = [turned_about_origin(body, quarters) for body in bodies]
    ends, ordered, method = _rectified(likenesses, config, faultless)
    moved = [taken_over(*three, quarters) for three in zip(bodies, likenesses, ends, strict=True)]
    where = {i: k for k, entity in enumerate(composites) for i in entity}
    if not faultless:
        filled = [carried_along(part, bodies[where[i]], moved[where[i]]) for i, part in enumerate(filled)]
    groups = [tuple(composites[k] for (k,) in group) for group in ordered]
    back = {i: k for k, i in enumerate(order)}
    return Rectified(
        tuple(filled[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in group) for group in groups),
        method,
    )


def _rectified(
    bodies: Sequence[RigidPart], config: RectifyConfig, faultless: bool
) -> tuple[list[RigidPart], list[Group], str]:
    """Rigid bodies moved, who of them holds together in radial order, and the method that it took.

    A cluster whose least motion is too much work, or has no answer, goes straight outward instead as in the paper:
    that always ends and keeps the order ("partly radial"). So does the whole layout ("radial") where the order of the
    trees around the most central one would change, or where that moves less.
    """
    clearance = config.clearance_m
    support = read_support(bodies, config.contact_m)
    trees = components(sorted(support.pairs), len(bodies))
    ordered = radial_order(bodies, [tuple((i,) for i in tree) for tree in trees])
    if faultless:
        return list(bodies), ordered, "joint"
    upright = [_put_down(body) if standing else body for body, standing in zip(bodies, support.standing, strict=True)]
    near = relaxed(upright, support, clearance)
    start = [bodies[i] if i in near.unsolved else part for i, part in enumerate(near.parts)]
    moved = _cleaned(start, support, ordered, clearance)
    kept = keeps_order(azimuths(bodies, ordered), azimuths(moved, ordered))
    if kept and _furthest(bodies, moved) <= FAR_M:
        return moved, ordered, _method(near)
    outward = _cleaned(bodies, support, ordered, clearance)
    if kept and _motion(bodies, moved) <= _motion(bodies, outward):
        return moved, ordered, _method(near)
    return outward, ordered, "radial"


def _method(near: Relaxed) -> str:
    if len(near.unsolved) == len(near.parts):
        return "radial"
    return "partly radial" if near.unsolved else "joint"


def keeps_order(before: Azimuths, after: Azimuths) -> bool:
    """Whether things seen at these azimuths from one point, counter-clockwise, still follow one another as before.

    Those that were behind one another, to within `SAME_WAY_RAD`, had no order among themselves. NaN, for what is in
    that point, follows anything.
    """
    known = ~(np.isnan(before) | np.isnan(after))
    around, ended = np.sort(before[known]), after[known][np.argsort(before[known], kind="stable")]
    if len(ended) < 2:
        return True
    first = int(np.argmax(_turns(around))) + 1
    around, ended = np.roll(around, -first), np.roll(ended, -first)
    ways = np.cumsum(np.concatenate([[False], _turns(around)[:-1] > SAME_WAY_RAD]))
    for way in np.unique(ways):
        mine = np.flatnonzero(ways == way)
        ended[mine] = ended[mine][np.argsort(_wrapped(ended[mine] - ended[mine[0]]), kind="stable")]
    return bool(_turns(ended).sum() < 3 * np.pi)


def _turns(angles: Azimuths) -> Azimuths:
    """From each angle counter-clockwise to the next, and from the last to the first; a hair clockwise is none [rad]."""
    steps = np.diff(angles, append=angles[:1])
    turns: Azimuths = np.maximum(np.mod(steps + SAME_WAY_RAD, 2 * np.pi) - SAME_WAY_RAD, 0.0)
    return turns


def _wrapped(angles: Azimuths) -> Azimuths:
    wrapped: Azimuths = np.mod(angles + np.pi, 2 * np.pi) - np.pi
    return wrapped


def _furthest(before: Sequence[RigidPart], after: Sequence[RigidPart]) -> float:
    return float(_distances(before, after).max())


def _motion(before: Sequence[RigidPart], after: Sequence[RigidPart]) -> float:
    return float((_distances(before, after) ** 2).sum())


def _distances(before: Sequence[RigidPart], after: Sequence[RigidPart]) -> Float64[np.ndarray, " n"]:
    """How far each part has been moved [m]."""
    ways = np.array([b.body.offset - a.body.offset for a, b in zip(before, after, strict=True)])
    distances: Float64[np.ndarray, " n"] = np.linalg.norm(ways, axis=1)
    return distances


def _put_down(part: RigidPart) -> RigidPart:
    flat = levelled(part, MOST_TILT_RAD)
    return flat.moved(-flat.lowest_now_m * UP)


def _cleaned(
    parts: Sequence[RigidPart], support: SupportRelation, ordered: Sequence[Group], clearance_m: float
) -> list[RigidPart]:
    """What is left of overlaps is removed exactly: upward within a tree, outward between trees; then all is let down.

    After the relaxation there is next to nothing left to remove.
    """
    raised = _raised(parts, support, ordered, clearance_m)
    return _lowered(spread(ground(raised, ordered), ordered, clearance_m), support, clearance_m)


def _raised(
    parts: Sequence[RigidPart], support: SupportRelation, groups: Sequence[Group], clearance_m: float
) -> list[RigidPart]:
    """Parts lifted, carriers first, out of those of their tree that were before them."""
    ray, lifted = Ray(UP), list(parts)
    order = upward(parts, support)
    for group in groups:
        settled: list[int] = []
        for i in (i for i in order if (i,) in group):
            height = ray.first_clear([lifted[i].body], [lifted[k].body for k in settled], clearance_m)
            lifted[i] = lifted[i].moved(height * UP)
            settled.append(i)
    return lifted


def _lowered(parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float) -> list[RigidPart]:
    """Parts let down until nothing sinks any more: what was let down late may have carried what was let down early."""
    lowered = list(parts)
    for _ in parts:
        before, lowered = lowered, _let_down(lowered, support, clearance_m)
        if _furthest(before, lowered) < AT_REST_M:
            break
    return lowered


def _let_down(parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float) -> list[RigidPart]:
    """Each part once, carriers first, until it meets the table or another part."""
    ray, lowered = Ray(-UP), list(parts)
    for i in upward(parts, support):
        others = [part.body for k, part in enumerate(lowered) if k != i]
        depth = ray.room([lowered[i].body], others, clearance_m - LET_DOWN_M, lowered[i].lowest_now_m)
        lowered[i] = lowered[i].moved(-depth * UP)
    return lowered


def upward(parts: Sequence[RigidPart], support: SupportRelation) -> list[int]:
    """Indices such that carriers come before what they carry, as far as that has an end; then by height and id."""
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
