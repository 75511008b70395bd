"""Phase 3: within a group, the broadest stays and the others rise until they are clear."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.geometry.collision.linear_sweep import LinearSweep
from tableverse_factory.stages.rectify.groups import Entity, Group
from tableverse_factory.stages.rectify.rigid_part import RigidPart, compute_breadth

UP = np.array([0.0, 0.0, 1.0])


def lift_contents(parts: Sequence[RigidPart], composites: Sequence[Entity], clearance_m: float) -> list[RigidPart]:
    """Lift the contents of each composite, one after the other, out of their container and of one another."""
    lifted = list(parts)
    for entity in composites:
        lift_in_turn(lifted, [(i,) for i in entity], [], clearance_m)
    return lifted


def disentangle(
    parts: Sequence[RigidPart], groups: Sequence[Group], clearance_m: float, against_all: bool = False
) -> list[RigidPart]:
    """Lift entities of smaller footprint until they are disjoint from the broader ones of their group.

    With `against_all` they also keep clear of the other groups, under whose overhang a part might rise.
    """
    lifted = list(parts)
    for group in groups:
        own = {i for entity in group for i in entity}
        others = [i for i in range(len(parts)) if i not in own] if against_all else []
        lift_in_turn(lifted, sorted(group, key=lambda entity: _rank_by_footprint(parts, entity)), others, clearance_m)
    return lifted


def _rank_by_footprint(parts: Sequence[RigidPart], entity: Entity) -> tuple[int, str]:
    own = [parts[i] for i in entity]
    return -compute_breadth(own), min(part.object_id for part in own)


def lift_in_turn(parts: list[RigidPart], order: Sequence[Entity], obstacles: Sequence[int], clearance_m: float) -> None:
    """Lift all entities but the first, in place, clear of those before them and of the obstacles."""
    ray = LinearSweep(UP)
    settled = list(order[0])
    for entity in order[1:]:
        fixed = [parts[i].body for i in (*settled, *obstacles)]
        height = ray.find_first_clear([parts[i].body for i in entity], fixed, clearance_m)
        for i in entity:
            parts[i] = parts[i].moved(height * UP)
        settled.extend(entity)
