"""Phase 1: which objects move as one, and down to the table with them (paper section 3.2)."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.geometry.collision.ray_clearance import are_within
from tableverse_factory.stages.rectify.rigid_part import RigidPart, box_of, breadth, overlap_ratio

Entity = tuple[int, ...]
"""Indices of an object and what it contains, the outermost container first: a composite moves as one."""
Group = tuple[Entity, ...]
"""Entities that stand over one another: they move sideways as one."""

RATIO_TOLERANCE = 1e-9


def entities(parts: Sequence[RigidPart]) -> list[Entity]:
    """Composites and single objects; a composite's contents follow their container, the broadest first.

    Should containers hold one another in a circle, the broadest of them counts as the outermost.
    """
    index = {part.object_id: i for i, part in enumerate(parts)}
    holder = [index.get(part.container_id or "", i) for i, part in enumerate(parts)]
    merged = components([(i, j) for i, j in enumerate(holder) if i != j], len(parts))
    return [tuple(sorted(members, key=lambda i: _rank(parts, holder, i))) for members in merged]


def group(parts: Sequence[RigidPart], composites: Sequence[Entity], ratio: float, contact_m: float) -> list[Group]:
    """Entities in contact whose top-view boxes share at least `ratio` of the smaller one's area are of one group.

    What shares less is apart sideways, touching or not, and will be pushed clear. Contact is a gap of at most
    `contact_m` between pieces: registration noise opens as many gaps as it closes, and what stands on another object
    but hovers a little must not be grounded on its own, which would drive it into what carries it.
    """
    boxes = [box_of([parts[i] for i in entity]) for entity in composites]
    pairs = [
        (a, b)
        for a in range(len(boxes))
        for b in range(a + 1, len(boxes))
        if overlap_ratio(boxes[a], boxes[b]) >= ratio - RATIO_TOLERANCE
        and _in_contact(parts, composites[a], composites[b], contact_m)
    ]
    return [tuple(composites[k] for k in members) for members in components(pairs, len(boxes))]


def ground(parts: Sequence[RigidPart], groups: Sequence[Group]) -> list[RigidPart]:
    """Moves every group up or down until its lowest vertex lies on the table plane z = 0."""
    grounded = list(parts)
    for members in groups:
        lowest = lowest_of(parts, members)
        for entity in members:
            for i in entity:
                grounded[i] = parts[i].moved(np.array([0.0, 0.0, -lowest]))
    return grounded


def lowest_of(parts: Sequence[RigidPart], members: Group) -> float:
    """Height of the lowest vertex of a group [m]."""
    return min(parts[i].lowest_now_m for entity in members for i in entity)


def components(pairs: Sequence[tuple[int, int]], count: int) -> list[tuple[int, ...]]:
    """Connected components of `count` nodes, each in ascending order, in the order of their first nodes."""
    leader = list(range(count))

    def find(i: int) -> int:
        while leader[i] != i:
            i = leader[i]
        return i

    for i, j in pairs:
        low, high = sorted((find(i), find(j)))
        leader[high] = low
    members: dict[int, list[int]] = {}
    for i in range(count):
        members.setdefault(find(i), []).append(i)
    return [tuple(found) for found in members.values()]


def _in_contact(parts: Sequence[RigidPart], a: Entity, b: Entity, contact_m: float) -> bool:
    return any(are_within(parts[i].body, parts[j].body, contact_m) for i in a for j in b)


def _rank(parts: Sequence[RigidPart], holder: Sequence[int], i: int) -> tuple[int, int, str]:
    depth, at = 0, i
    while holder[at] != at and depth < len(parts):
        depth, at = depth + 1, holder[at]
    return depth, -breadth([parts[i]]), parts[i].object_id
