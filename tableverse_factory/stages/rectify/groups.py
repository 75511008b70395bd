"""Phase 1: group objects that move as one, and put the groups on the table (paper section 3.2)."""

from collections.abc import Sequence
from itertools import chain, combinations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tableverse_factory.geometry.collision.linear_sweep import are_within
from tableverse_factory.stages.rectify.rigid_part import RigidPart, compute_box, compute_breadth, compute_overlap_ratio

Entity = tuple[int, ...]  # an object and what it contains, the outermost container first: a composite moves as one
Group = tuple[Entity, ...]  # entities that stand over one another: they move sideways as one

RATIO_TOLERANCE = 1e-9


def form_entities(parts: Sequence[RigidPart]) -> list[Entity]:
    """Form composites and single objects; contents follow their container, the broadest first.

    In a containment cycle the broadest container counts as the outermost.
    """
    index = {part.object_id: i for i, part in enumerate(parts)}
    holder = [index.get(part.container_id or "", i) for i, part in enumerate(parts)]
    merged = connect_components([(i, j) for i, j in enumerate(holder) if i != j], len(parts))
    return [tuple(sorted(members, key=lambda i: _rank_in_entity(parts, holder, i))) for members in merged]


def form_groups(
    parts: Sequence[RigidPart], composites: Sequence[Entity], ratio: float, contact_m: float
) -> list[Group]:
    """Group entities in contact whose top-view boxes share at least `ratio` of the smaller one's area.

    Others are beside each other and will be pushed clear. Contact is a gap of at most `contact_m` between pieces:
    an object that hovers a little over its carrier, by registration noise, must not be grounded into it.
    """
    boxes = [compute_box([parts[i] for i in entity]) for entity in composites]
    pairs = [
        (a, b)
        for a, b in combinations(range(len(boxes)), 2)
        if compute_overlap_ratio(boxes[a], boxes[b]) >= ratio - RATIO_TOLERANCE
        and any(are_within(parts[i].body, parts[j].body, contact_m) for i in composites[a] for j in composites[b])
    ]
    return [tuple(composites[k] for k in members) for members in connect_components(pairs, len(boxes))]


def ground_groups(parts: Sequence[RigidPart], groups: Sequence[Group]) -> list[RigidPart]:
    """Move every group up or down until its lowest vertex lies on the table plane z = 0."""
    grounded = list(parts)
    for members in groups:
        lowest = measure_lowest_m(parts, members)
        for i in chain(*members):
            grounded[i] = parts[i].moved(np.array([0.0, 0.0, -lowest]))
    return grounded


def measure_lowest_m(parts: Sequence[RigidPart], members: Group) -> float:
    """Measure the height of the lowest vertex of a group [m]."""
    return min(parts[i].lowest_now_m for i in chain(*members))


def connect_components(pairs: Sequence[tuple[int, int]], count: int) -> list[tuple[int, ...]]:
    """Find the connected components of `count` nodes, each in ascending order, in the order of their first nodes."""
    first, second = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    edges = coo_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    _, label = connected_components(edges, directed=False)
    members: dict[int, list[int]] = {}
    for i, component in enumerate(label.tolist()):
        members.setdefault(component, []).append(i)
    return [tuple(found) for found in members.values()]


def _rank_in_entity(parts: Sequence[RigidPart], holder: Sequence[int], i: int) -> tuple[int, int, str]:
    depth, at = 0, i
    while holder[at] != at and depth < len(parts):
        depth, at = depth + 1, holder[at]
    return depth, -compute_breadth([parts[i]]), parts[i].object_id
