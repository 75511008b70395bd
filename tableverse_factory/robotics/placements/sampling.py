"""Where an object is put down so that a relation holds: bounded rejection sampling (paper, section 3.4, appendix D).

Samples of the relation's domain, at eight headings, are rejected until boxes are clear of one another and of the
table's edge; what is left is judged on shapes. On the table the object stands at its lowest point; on or into
something it is let down on height maps until it touches, must then stand on a level patch below its centre or fit
within the rim, and what is promised at last is that `geometry.relations.holds` says so of the object at rest.
"""

from collections.abc import Iterable

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.curation import Relation
from schemas.trajectories import Placement
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.domains import Predicate
from tableverse_factory.robotics.placements.next_to import beside
from tableverse_factory.robotics.placements.on_and_in import upon
from tableverse_factory.robotics.placements.orientations import turns, turns_on_end
from tableverse_factory.robotics.placements.request import NoPlacement, PlacementRequest


def placements(
    relation: Relation,
    x: SceneObject,
    y: SceneObject,
    others: Iterable[SceneObject],
    table: Slab,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
) -> tuple[Placement, ...] | NoPlacement:
    """Up to `config.placements` poses in which to let go of `x`, best first, or why there is none.

    Best are places with room around, near the reference, little turned, and where nobody doubts the relation; places
    that differ come before those that are alike. The object keeps the face that it rests on now; a long one that does
    not fit into a vessel that way is stood on its end. A place in a vessel may come as two placements, one down in it
    and one from above its rim, for the hand may not fit in.

    Args:
        relation: That is to hold in the end.
        x: What is put down.
        y: The reference.
        others: All other things of the scene.
        table: On which they stand.
        config: `placements`, `epsilon_m` and `delta_margin_m` are read.
        rng: Same state, same placements.
    """
    request = PlacementRequest(
        relation, x, y, tuple(others), table, config.epsilon_m, config.delta_margin_m, config.placements
    )
    lets_down = request.predicate in (Predicate.TOP, Predicate.IN)
    found = (upon if lets_down else beside)(request, turns(x.standing, x.body), rng)
    if isinstance(found, NoPlacement) and request.predicate is Predicate.IN and y.body.cavity is not None:
        on_end = turns_on_end(x.standing, x.body.heights.cell)
        found = upon(request, on_end, rng, on_end=True) if on_end else found
    if isinstance(found, NoPlacement):
        return found
    return tuple(placement for place in found for placement in place.placements(x.pose))[: config.placements]
