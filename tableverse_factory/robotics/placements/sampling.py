"""Bounded rejection sampling of placements that satisfy a relation (paper, section 3.4, appendix D).

Samples of the relation's domain, at eight headings, are rejected until boxes are clear of one another and of the
table's edge; the remainder is checked on true shapes. On the table the object stands at its lowest point. On or into a
reference it is lowered on height maps until it touches, and must stand on a level patch below its center or fit within
the rim. A placement is returned only if `geometry.relations.holds` confirms the relation for the object at rest.
"""

from collections.abc import Iterable

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.curation import Relation
from schemas.trajectories import Placement
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.domains import SIDES
from tableverse_factory.robotics.placements.next_to import find_places_beside
from tableverse_factory.robotics.placements.on_and_in import find_places_on_or_in
from tableverse_factory.robotics.placements.orientations import list_orientations, list_upright_orientations
from tableverse_factory.robotics.placements.request import NoPlacement, PlacementRequest


def sample_placements(
    relation: Relation,
    x: SceneObject,
    y: SceneObject,
    others: Iterable[SceneObject],
    table: Slab,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
) -> tuple[Placement, ...] | NoPlacement:
    """Sample up to `config.placements` release poses of `x`, best first, or return why there is none.

    Placements with clearance, near the reference, little turned and with an unambiguous relation come first; distinct
    ones before alike ones. The object keeps its present face down; a long one that does not fit into a vessel that way
    is stood on its end. A place in a vessel may give two placements, one down in it and one above its rim for large
    hands.
    """
    request = PlacementRequest(
        relation, x, y, tuple(others), table, config.epsilon_m, config.delta_margin_m, config.placements
    )
    beside, turns = relation in SIDES, list_orientations(x.standing, x.body)
    found = (find_places_beside if beside else find_places_on_or_in)(request, turns, rng)
    into = not beside and relation is not Relation.ON
    if isinstance(found, NoPlacement) and into and y.body.cavity is not None:
        on_end = list_upright_orientations(x.standing, x.body.heights.cell)
        found = find_places_on_or_in(request, on_end, rng, on_end=True) if on_end else found
    if isinstance(found, NoPlacement):
        return found
    return tuple(placement for place in found for placement in place.to_placements(x.pose))[: config.placements]
