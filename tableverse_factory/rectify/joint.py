"""Joint rectification: the whole layout moves as little as it can, and who carries whom stays."""

from collections.abc import Sequence

import numpy as np

from schemas.config import RectifyConfig
from tableverse_factory.geometry.clearance import Ray
from tableverse_factory.rectify.groups import Group, components, entities, ground
from tableverse_factory.rectify.lccr import Rectified
from tableverse_factory.rectify.levelling import levelled
from tableverse_factory.rectify.parts import Part, carried_along, merged
from tableverse_factory.rectify.radial import radial_order, spread
from tableverse_factory.rectify.relaxation import Relaxation
from tableverse_factory.rectify.support import Support, read_support
from tableverse_factory.rectify.vertical import UP, fill

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
    moved, trees = _rectified(bodies, config)
    where = {i: k for k, entity in enumerate(composites) for i in entity}
    ended = [carried_along(part, bodies[where[i]], moved[where[i]]) for i, part in enumerate(filled)]
    groups: list[Group] = [tuple(composites[k] for k in tree) for tree in trees]
    back = {i: k for k, i in enumerate(order)}
    return Rectified(
        tuple(ended[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in group) for group in radial_order(given, groups)),
    )


def _rectified(bodies: Sequence[Part], config: RectifyConfig) -> tuple[list[Part], list[tuple[int, ...]]]:
    """Rigid bodies moved, and who of them holds together."""
    support = read_support(bodies, config.contact_m)
    upright = [_put_down(body) if standing else body for body, standing in zip(bodies, support.standing, strict=True)]
    near = Relaxation(upright, support, config.clearance_m).result()
    trees = components(sorted(support.pairs), len(bodies))
    groups: list[Group] = [tuple((i,) for i in tree) for tree in trees]
    apart = _spread(_raised(near, support, config.clearance_m), groups, config)
    return _lowered(apart, support, config.clearance_m), trees


def _put_down(part: Part) -> Part:
    flat = levelled(part, MOST_TILT_RAD)
    return flat.moved(-flat.lowest_now_m * UP)


def _raised(parts: Sequence[Part], support: Support, clearance_m: float) -> list[Part]:
    """Parts lifted, the lowest first, out of those of their tree that were before them."""
    ray, lifted = Ray(UP), list(parts)
    settled: list[int] = []
    for i in upward(parts, support):
        height = ray.first_clear([lifted[i].body], [lifted[k].body for k in settled], clearance_m)
        lifted[i] = lifted[i].moved(height * UP)
        settled.append(i)
    return lifted


def _spread(parts: Sequence[Part], trees: Sequence[Group], config: RectifyConfig) -> list[Part]:
    grounded = ground(parts, trees)
    return spread(grounded, radial_order(grounded, trees), config.clearance_m)


def _lowered(parts: Sequence[Part], support: Support, clearance_m: float) -> list[Part]:
    """Parts let down, the lowest first, until they meet the table or another part."""
    ray, lowered = Ray(-UP), list(parts)
    for i in upward(parts, support):
        others = [part.body for k, part in enumerate(lowered) if k != i]
        depth = ray.room([lowered[i].body], others, clearance_m, lowered[i].lowest_now_m)
        lowered[i] = lowered[i].moved(-depth * UP)
    return lowered


def upward(parts: Sequence[Part], support: Support) -> list[int]:
    """Indices such that carriers come before what they carry, as far as that has an end; then by height and id."""
    rank = sorted(range(len(parts)), key=lambda i: (not support.standing[i], parts[i].lowest_now_m, parts[i].object_id))
    done: list[int] = []
    while rank:
        ready = [i for i in rank if all(low in done for up, low in support.pairs if up == i)]
        done.append(ready[0] if ready else rank[0])
        rank.remove(done[-1])
    return done
