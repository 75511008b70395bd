"""What is asked for, and the answers to it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from schemas.curation import Relation
from schemas.geometry import Frozen, Pose, Vector3
from schemas.trajectories import Placement
from tableverse_factory.geometry.math.transforms import compose, rotation_matrix
from tableverse_factory.geometry.relations.relations import BodyFeatures, holds
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.domains import (
    PREDICATES,
    PlacementRegion,
    Points2,
    Predicate,
    Vector2,
    domain,
    sampled,
)
from tableverse_factory.robotics.placements.orientations import Turn

RELEASE_M = 0.002
"""An object is let go this high above what it will stand on: pressed down, it would push back at the arm."""

SAMPLES = 100
"""Samples for each place that is wanted (`TrajectoriesConfig.placements`)."""


LOOKS = 6
"""Samples that are judged on shapes for each place that is wanted, at most: this is what takes time."""

ENOUGH = 6
"""With so many places between boxes none is looked for between outlines."""


@dataclass(frozen=True, slots=True)
class NoPlacement:
    """That there is no place.

    Attributes:
        reason: `no_container`, `no_stable_top`, `does_not_stand` or `no_room`.
        detail: One line for people, with what was tried.
    """

    reason: str
    detail: str


@dataclass(frozen=True, slots=True, eq=False)
class Place(Frozen):
    """Where the object would come to rest.

    Attributes:
        turn: Its heading.
        offset: From the turned object to the object at rest [m].
        drops: Heights from which it may be let go, the better first [m].
        clear_by: As in `Placement`.
    """

    turn: Turn
    offset: Vector3
    drops: tuple[float, ...]
    clear_by: str

    def placements(self, standing: Pose) -> Iterator[Placement]:
        """As poses of the object's own frame, which now stands at `standing`."""
        for drop in self.drops:
            moved = Pose(self.offset + np.array([0.0, 0.0, drop]), self.turn.quaternion_wxyz)
            yield Placement(compose(moved, standing), drop, self.clear_by)


@dataclass(frozen=True, slots=True)
class PlacementRequest:
    """A relation between two things of a scene.

    Attributes:
        relation: That is to hold.
        x: What is put down.
        y: The reference.
        others: What else stands there.
        table: What all stand on.
        epsilon_m: Least gap to other boxes [m].
        delta_margin_m: Least gap along the axis of a side [m].
        wanted: How many places.
    """

    relation: Relation
    x: SceneObject
    y: SceneObject
    others: tuple[SceneObject, ...]
    table: Slab
    epsilon_m: float
    delta_margin_m: float
    wanted: int

    @property
    def predicate(self) -> Predicate:
        """The domain that the relation is mapped to."""
        return PREDICATES[self.relation]

    @property
    def cell(self) -> float:
        """Spacing of the height maps, by which objects are moved [m]."""
        return self.x.body.heights.cell

    @property
    def bodies(self) -> tuple[BodyFeatures, ...]:
        """The others as they stand."""
        return tuple(other.body for other in self.others)

    @property
    def lowest(self) -> float:
        """Height of the lowest point of the object as it stands, of its mesh or of its pieces [m]."""
        low = rotation_matrix(self.x.pose.quaternion_wxyz)[2]
        pieces = min(float((hull.vertices @ low).min()) for hull in self.x.hulls) + float(self.x.pose.position[2])
        return min(pieces, float(self.x.body.low[2]))

    def avoided(self) -> Vector2 | None:
        """The middle of the object as it stands, where the relation holds already: it is to be moved."""
        body = self.x.body
        middle: Vector2 = (body.low + body.high)[:2] / 2
        return middle if holds(self.relation, body, self.y.body) else None

    def regions(self, turn: Turn) -> tuple[PlacementRegion, ...]:
        """The domain, for the middle of the turned object's box."""
        half = (turn.body.high - turn.body.low)[:2] / 2
        return domain(self.predicate, half, self.y.body, self.delta_margin_m)

    def cells(self, turn: Turn, count: int, rng: np.random.Generator) -> tuple[np.ndarray, Points2]:
        """Samples of the domain above the table: by how many cells to move, each once, and the middles of the boxes.

        Shapes (n, 2), n at most `count`.
        """
        regions, middle = self.regions(turn), (turn.body.low + turn.body.high)[:2] / 2
        reach = float(np.linalg.norm(self.table.half_size_xy))
        near = tuple(r.within(self.table.center_xy - reach, self.table.center_xy + reach) for r in regions)
        found = np.rint((sampled(near, count, rng) - middle) / self.cell).astype(np.int64)
        cells = np.unique(found, axis=0).reshape(-1, 2)
        middles: Points2 = middle + cells * self.cell
        inside = np.zeros(len(cells), dtype=bool)
        for region in regions:
            inside |= region.holds(middles)
        return cells[inside], middles[inside]
