"""Placement requests and their results."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.curation import Relation
from schemas.geometry import Frozen, Pose, Vector3
from schemas.trajectories import Placement
from tableverse_factory.geometry.math.transforms import compose_poses, rotation_matrix
from tableverse_factory.geometry.relations.relations import BodyFeatures, relation_holds
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.domains import (
    Points2,
    Vector2,
    build_domain,
    sample_regions,
)
from tableverse_factory.robotics.placements.orientations import Orientation

# Placements nearer than this at one heading are alike: a planner that fails at one will fail at the other
ALIKE_RADIUS_M = 0.02
AVOIDED_RADIUS_M = 0.04  # placements nearer than this to an avoided point come last
RELEASE_HEIGHT_M = 0.002  # release height above the support: a pressed-down object would push back at the arm
SAMPLES_PER_PLACEMENT = 100  # samples per requested placement (`TrajectoriesConfig.placements`)
CHECKS_PER_PLACEMENT = 6  # maximum number of samples per requested placement checked on true shapes, the expensive part
ENOUGH_CLEAR = 6  # with this many placements clear by boxes, outlines are not tried
Accepted = TypeVar("Accepted")


@dataclass(frozen=True, slots=True, eq=False)
class PlacementSamples(Frozen):
    """Samples of one or of all headings."""

    heading: Int64[np.ndarray, " n"]  # index of the heading
    cells: Int64[np.ndarray, "n 2"]  # offset of the rotated object in cells of its map
    middles: Points2  # of its box there [m]
    costs: Float64[np.ndarray, " n"]
    clear: Bool[np.ndarray, " n"]  # whether boxes are clear there

    def rank(self, avoided: Vector2 | None) -> list[int]:
        """Rank indices: clear boxes, then others, then those near `avoided` [m]; each by cost, alike ones last."""
        late = np.zeros(len(self.costs), dtype=bool)
        if avoided is not None:
            late = np.linalg.norm(self.middles - avoided, axis=1) < AVOIDED_RADIUS_M
        order: list[int] = []
        for part in (self.clear & ~late, ~self.clear & ~late, late):
            cheapest = np.flatnonzero(part)[np.argsort(self.costs[part], kind="stable")]
            order += self._put_alike_last(cheapest)
        return order

    def _put_alike_last(self, order: Int64[np.ndarray, " k"]) -> list[int]:
        left, firsts = order, list[int]()
        while len(left):
            first = left[0]
            firsts.append(int(first))
            near = (np.abs(self.middles[left] - self.middles[first]) < ALIKE_RADIUS_M).all(axis=1)
            left = left[~(near & (self.heading[left] == self.heading[first]))]
        return [*firsts, *map(int, order[~np.isin(order, firsts)])]


@dataclass(frozen=True, slots=True)
class NoPlacement:
    """Reason why there is no placement."""

    reason: str  # `no_container`, `no_stable_top`, `does_not_stand` or `no_room`
    detail: str  # one line for people, with the tally of rejections


@dataclass(frozen=True, slots=True, eq=False)
class CandidatePlacement(Frozen):
    """Place where the object would come to rest."""

    turn: Orientation
    offset: Vector3  # from the rotated object to the object at rest [m]
    drops: tuple[float, ...]  # release heights, best first [m]
    clear_by: str  # as in `Placement`

    def to_placements(self, standing: Pose) -> Iterator[Placement]:
        """Convert to poses of the object's own frame, which now stands at `standing`."""
        for drop in self.drops:
            moved = Pose(self.offset + np.array([0.0, 0.0, drop]), self.turn.quaternion_wxyz)
            yield Placement(compose_poses(moved, standing), drop, self.clear_by)


@dataclass(frozen=True, slots=True)
class PlacementRequest:
    """Relation to achieve between an object and a reference of a scene."""

    relation: Relation
    x: SceneObject  # to place
    y: SceneObject  # reference
    others: tuple[SceneObject, ...]
    table: Slab
    epsilon_m: float  # minimum gap to other boxes
    delta_margin_m: float  # minimum gap along the axis of a side
    wanted: int  # number of placements

    @property
    def cell(self) -> float:
        """Cell size of the height maps, by which objects are moved [m]."""
        return self.x.body.heights.cell

    @property
    def bodies(self) -> tuple[BodyFeatures, ...]:
        """Shapes of the other objects as they stand."""
        return tuple(other.body for other in self.others)

    @property
    def lowest(self) -> float:
        """Height of the lowest point of the object's mesh and pieces as it stands [m]."""
        low = rotation_matrix(self.x.pose.quaternion_wxyz)[2]
        pieces = min(float((hull.vertices @ low).min()) for hull in self.x.hulls) + float(self.x.pose.position[2])
        return min(pieces, float(self.x.body.low[2]))

    def sample_cells(self, turn: Orientation, count: int, rng: np.random.Generator) -> tuple[np.ndarray, Points2]:
        """Sample at most `count` distinct cell offsets in the domain above the table, and the boxes' middles."""
        half, middle = (turn.body.high - turn.body.low)[:2] / 2, (turn.body.low + turn.body.high)[:2] / 2
        regions = build_domain(self.relation, half, self.y.body, self.delta_margin_m)
        reach = float(np.linalg.norm(self.table.half_size_xy))
        near = tuple(r.intersect(self.table.center_xy - reach, self.table.center_xy + reach) for r in regions)
        found = np.rint((sample_regions(near, count, rng) - middle) / self.cell).astype(np.int64)
        cells = np.unique(found, axis=0).reshape(-1, 2)
        middles: Points2 = middle + cells * self.cell
        inside = np.zeros(len(cells), dtype=bool)
        for region in regions:
            inside |= region.contains(middles)
        return cells[inside], middles[inside]

    def judge_samples(
        self, parts: Sequence[PlacementSamples], judge: Callable[[int, np.ndarray, bool], Accepted | None]
    ) -> list[Accepted]:
        """Judge the samples of all headings, best first, by heading, cells and clearness, until enough are accepted.

        Where the relation holds already, places near the present one come last, as the object has to move.
        """
        columns = zip(*([getattr(part, field.name) for field in fields(part)] for part in parts), strict=True)
        samples, body = PlacementSamples(*map(np.concatenate, columns)), self.x.body
        avoided = (body.low + body.high)[:2] / 2 if relation_holds(self.relation, body, self.y.body) else None
        found: list[Accepted] = []
        for index in samples.rank(avoided)[: CHECKS_PER_PLACEMENT * self.wanted]:
            clear = bool(samples.clear[index])
            if len(found) == self.wanted or (len(found) >= ENOUGH_CLEAR and not clear):
                break
            if (place := judge(int(samples.heading[index]), samples.cells[index], clear)) is not None:
                found.append(place)
        return found
