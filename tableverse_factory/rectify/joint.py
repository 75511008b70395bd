"""Joint rectification: the whole layout moves as little as it can, and who carries whom stays."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float64

from schemas.config import RectifyConfig
from tableverse_factory.errors import SolverError
from tableverse_factory.geometry.clearance import LEAST_MARGIN_M, TOLERANCE_M, Ray, are_within
from tableverse_factory.rectify.groups import Group, components, entities, ground
from tableverse_factory.rectify.lccr import Rectified
from tableverse_factory.rectify.levelling import levelled
from tableverse_factory.rectify.parts import Part, carried_along, merged
from tableverse_factory.rectify.quarters import quarters_of, taken_over, turned_about_origin
from tableverse_factory.rectify.radial import azimuths, radial_order, spread
from tableverse_factory.rectify.relaxation import Relaxation
from tableverse_factory.rectify.support import Support, read_support
from tableverse_factory.rectify.vertical import UP, fill

Azimuths = Float64[np.ndarray, " n"]

AT_REST_M = 1e-6
"""A layout in which nothing would be put down further than this, and which is free, is left alone [m]."""
MOST_TILT_RAD = np.radians(4.0)
"""What stands is levelled by at most this; more is no noise."""


def joint(parts: Sequence[Part], config: RectifyConfig) -> Rectified:
    """Moves parts until none is nearer to another than the clearance, all of them together and as little as possible.

    A composite moves as one. The result depends on ids and geometry, not on the order of `parts`.
    """
    order = sorted(range(len(parts)), key=lambda i: parts[i].object_id)
    given = [parts[i] for i in order]
    composites = entities(given)
    filled = fill(given, composites, config.clearance_m)
    bodies = [merged([filled[i] for i in entity]) for entity in composites]
    quarters = quarters_of(bodies)
    likenesses = [turned_about_origin(body, quarters) for body in bodies]
    ends, trees, method = _rectified(likenesses, config)
    moved = [taken_over(*three, quarters) for three in zip(bodies, likenesses, ends, strict=True)]
    where = {i: k for k, entity in enumerate(composites) for i in entity}
    ended = [carried_along(part, bodies[where[i]], moved[where[i]]) for i, part in enumerate(filled)]
    groups: list[Group] = [tuple(composites[k] for k in tree) for tree in trees]
    back = {i: k for k, i in enumerate(order)}
    return Rectified(
        tuple(ended[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in group) for group in radial_order(given, groups)),
        method,
    )


def _rectified(bodies: Sequence[Part], config: RectifyConfig) -> tuple[list[Part], list[tuple[int, ...]], str]:
    """Rigid bodies moved, who of them holds together, and the method that it took.

    Where the least motion is too much work, has no answer, or would change the order of the trees around the most
    central one, each goes straight outward instead ("radial"), as in the paper: that always ends and keeps the order.
    """
    clearance = config.clearance_m
    support = read_support(bodies, config.contact_m)
    trees = components(sorted(support.pairs), len(bodies))
    groups: list[Group] = [tuple((i,) for i in tree) for tree in trees]
    if _is_done(bodies, support, clearance):
        return list(bodies), trees, "joint"
    upright = [_put_down(body) if standing else body for body, standing in zip(bodies, support.standing, strict=True)]
    ordered = radial_order(bodies, groups)
    try:
        near = Relaxation(upright, support, clearance).result()
    except SolverError:
        return _cleaned(bodies, support, ordered, clearance), trees, "radial"
    moved = _cleaned(near, support, ordered, clearance)
    if not keeps_order(azimuths(bodies, ordered), azimuths(moved, ordered)):
        return _cleaned(bodies, support, ordered, clearance), trees, "radial"
    return moved, trees, "joint"


def keeps_order(before: Azimuths, after: Azimuths) -> bool:
    """Whether things seen at these azimuths from one point, counter-clockwise, still follow one another as before.

    NaN, for what is in that point, follows anything.
    """
    known = ~(np.isnan(before) | np.isnan(after))
    around = after[known][np.argsort(before[known], kind="stable")]
    steps = np.mod(np.diff(around, append=around[:1]), 2 * np.pi)
    return bool(steps.sum() < 3 * np.pi)


def _is_done(bodies: Sequence[Part], support: Support, clearance_m: float) -> bool:
    """Whether all is free and lies on something as it is."""
    if any(_too_near(a, b, clearance_m) for a, b in combinations(bodies, 2)):
        return False
    if any(abs(min(body.lowest_now_m, 0.0)) > AT_REST_M for body in bodies):
        return False
    return _furthest(bodies, _let_down(bodies, support, clearance_m)) < AT_REST_M


def _furthest(before: Sequence[Part], after: Sequence[Part]) -> float:
    return max(float(np.linalg.norm(b.body.offset - a.body.offset)) for a, b in zip(before, after, strict=True))


def _too_near(a: Part, b: Part, clearance_m: float) -> bool:
    margin = max(clearance_m + a.body.uncovered_m + b.body.uncovered_m, LEAST_MARGIN_M)
    return are_within(a.body, b.body, margin - 2 * TOLERANCE_M)


def _put_down(part: Part) -> Part:
    flat = levelled(part, MOST_TILT_RAD)
    return flat.moved(-flat.lowest_now_m * UP)


def _cleaned(parts: Sequence[Part], support: Support, ordered: Sequence[Group], clearance_m: float) -> list[Part]:
    """What is left of overlaps is removed exactly: upward within a tree, outward between trees; then all is let down.

    After the relaxation there is next to nothing left to remove.
    """
    raised = _raised(parts, support, ordered, clearance_m)
    return _lowered(spread(ground(raised, ordered), ordered, clearance_m), support, clearance_m)


def _raised(parts: Sequence[Part], support: Support, groups: Sequence[Group], clearance_m: float) -> list[Part]:
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


def _lowered(parts: Sequence[Part], support: Support, clearance_m: float) -> list[Part]:
    """Parts let down until nothing sinks any more: what was let down late may have carried what was let down early."""
    lowered = list(parts)
    for _ in parts:
        before, lowered = lowered, _let_down(lowered, support, clearance_m)
        if _furthest(before, lowered) < AT_REST_M:
            break
    return lowered


def _let_down(parts: Sequence[Part], support: Support, clearance_m: float) -> list[Part]:
    """Each part once, carriers first, until it meets the table or another part."""
    ray, lowered = Ray(-UP), list(parts)
    for i in upward(parts, support):
        others = [part.body for k, part in enumerate(lowered) if k != i]
        depth = ray.room([lowered[i].body], others, clearance_m, lowered[i].lowest_now_m)
        lowered[i] = lowered[i].moved(-depth * UP)
    return lowered


def upward(parts: Sequence[Part], support: Support) -> list[int]:
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
