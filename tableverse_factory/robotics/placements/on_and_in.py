"""Places on or in the reference: let down from above until the object touches, by height maps."""

from collections import Counter

import numpy as np
from scipy import ndimage

from tableverse_factory.geometry.mesh.height_maps import CellMask, Heights
from tableverse_factory.geometry.relations.relations import BodyFeatures, holds, is_inside
from tableverse_factory.geometry.relations.stable_placement import CONTACT_M, dropped, stands, tabletop
from tableverse_factory.robotics.placements.clearance import least_gaps, outlines_clear
from tableverse_factory.robotics.placements.domains import Predicate
from tableverse_factory.robotics.placements.orientations import Turn
from tableverse_factory.robotics.placements.pieces import Pieces
from tableverse_factory.robotics.placements.request import (
    ENOUGH,
    LOOKS,
    RELEASE_M,
    SAMPLES,
    NoPlacement,
    Place,
    PlacementRequest,
)
from tableverse_factory.robotics.placements.samples import Samples, joined

FINGERS_M = 0.02
"""How far fingers reach down beside what they hold, from its top, at least."""

HAND_ROOM_M = 0.05
"""Where a vessel is wider than the object by this, fingers may come in with it."""

WALL_CLEARANCE_M = 0.001
"""The convex pieces of what is let go in a vessel are so far from its own."""

MAX_RISE_M = 0.012
"""Where the pieces are only clear so much higher than the meshes, the object does not fit for a simulator."""

WALL_GAP_M = 0.006
"""What keeps so far from the wall goes in easily."""

_CORE = 0.6
"""Share of its width with which an object feels for the ground."""

_LEVEL_M = 0.03
"""To lie so much higher in a vessel is as bad as to lie at its wall."""

_DEEP_M = 0.05
"""Further from the edge than this a place is no better."""


def upon(
    request: PlacementRequest, turns: tuple[Turn, ...], rng: np.random.Generator, *, on_end: bool = False
) -> tuple[Place, ...] | NoPlacement:
    """Places on or in the reference, best first; at most as many as are wanted.

    Args:
        request: What is asked for.
        turns: Ways to hold the object.
        rng: The only source of chance.
        on_end: Whether it is stood on its end, and must not topple out again.
    """
    y = request.y.body
    if request.predicate is Predicate.TOP:
        if not y.flat.any():
            return NoPlacement("no_stable_top", f"{request.y.object_id} has no level patch that carries anything")
        return _Reference(request, turns, y.flat, on_end=False).places(rng)
    if y.cavity is None:
        return NoPlacement("no_container", f"{request.y.object_id} has no room that opens upwards")
    return _Reference(request, turns, y.cavity.cells, on_end=on_end).places(rng)


class _Reference:
    """The reference with what stands near it."""

    def __init__(self, request: PlacementRequest, turns: tuple[Turn, ...], room: CellMask, *, on_end: bool) -> None:
        self._on_end = on_end
        self._request, self._turns, self._y = request, turns, request.y.body
        self._into = request.predicate is Predicate.IN
        size = max(float(np.linalg.norm((turn.body.high - turn.body.low)[:2])) for turn in turns)
        things = [o for o in request.others if _box_gap(o.body, self._y) < size]
        near = tuple(o.body for o in things)
        self._pieces = Pieces(request.x, (request.y, *things))
        # Contents lie where the object is to go: it is let down onto them, by the map; boxes would keep it out.
        self._beside = tuple(o for o in near if not (self._into and self._is_content(o)))
        self._scene = tabletop((self._y, *near), request.table, request.cell, size + 2 * request.cell)
        self._heights = self._scene.without(None)
        self._ground = self._heights[self._scene.window_of(self._y.heights)]
        free = room if self._into else room & (self._ground <= self._y.heights.top + CONTACT_M)
        self._depth: Heights = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * request.cell

    def places(self, rng: np.random.Generator) -> tuple[Place, ...] | NoPlacement:
        """Where the object stands, or lies well within the rim, clear of what is beside, and the relation holds."""
        wanted = self._request.wanted
        count = -(-SAMPLES * wanted // len(self._turns))
        samples = joined([self._sampled(turn, index, count, rng) for index, turn in enumerate(self._turns)])
        found: list[tuple[bool, Place]] = []
        lost: Counter[str] = Counter()
        for index in samples.order(self._request.avoided())[: LOOKS * wanted]:
            if len(found) == wanted or (len(found) >= ENOUGH and not samples.clear[index]):
                break
            place = self._let_down(self._turns[samples.heading[index]], samples.cells[index], lost)
            found += [] if place is None else [place]
        told = ", ".join(f"{many} {why}" for why, many in lost.items()) or "none over it"
        easy_first = sorted(found, key=lambda entry: entry[0])
        return tuple(place for _, place in easy_first) or NoPlacement("no_room", f"of {len(samples.costs)} {told}")

    def _sampled(self, turn: Turn, heading: int, count: int, rng: np.random.Generator) -> Samples:
        """Samples with what counts over the room: the centre of what stands, the middle of what goes in.

        The deepest spot is always among them: a small room in a large box may be missed.
        """
        request, body, shape = self._request, turn.body, np.array(self._depth.shape)
        middle = (body.low + body.high)[:2] / 2
        counts = middle if self._into else body.center[:2]
        start = np.floor(counts / request.cell).astype(np.int64) - np.array(self._y.heights.corner)
        deepest = np.array(np.unravel_index(int(np.argmax(self._depth)), self._depth.shape))
        cells = np.concatenate([(deepest - start)[None], request.cells(turn, count, rng)[0]])
        there = ((start + cells >= 0) & (start + cells < shape)).all(axis=1)
        cells = cells[there]
        index = tuple((start + cells).T)
        kept = self._depth[index] > 0.0
        level = self._level(body)[index][kept]
        offset = np.column_stack([cells[kept] * request.cell, level - body.low[2]])
        gap = least_gaps(body.low + offset, body.high + offset, self._beside, over_lower=True)
        costs = 1.0 - np.minimum(self._depth[index][kept], _DEEP_M) / _DEEP_M + 0.5 * turn.angle / np.pi
        costs += (
            (level - level.min(initial=np.inf)) / _LEVEL_M if self._into else 1.0 - np.clip(gap, 0, _DEEP_M) / _DEEP_M
        )
        heading_of = np.full(len(level), heading)
        return Samples(heading_of, cells[kept], middle + offset[:, :2], costs, gap >= request.epsilon_m)

    def _level(self, body: BodyFeatures) -> Heights:
        """About how high the lowest point of a body would come to lie, over each cell of the reference."""
        if not self._into:
            return self._y.heights.top
        half = (body.high - body.low)[:2] / 2
        size = np.maximum(np.rint(_CORE * half / self._request.cell).astype(int), 0) * 2 + 1
        level: Heights = ndimage.maximum_filter(self._ground, size=tuple(size), mode="nearest")
        return level

    def _let_down(self, turn: Turn, cells: np.ndarray, lost: Counter[str]) -> tuple[bool, Place] | None:
        """The place, and whether it is a tight one; None where it is none."""
        request = self._request
        by_cells = (int(cells[0]), int(cells[1]))
        landed = dropped(request.relation, turn.body, by_cells, self._y, self._scene, self._heights)
        if landed is None:
            lost["where it would not fit or stand"] += 1
            return None
        if not holds(request.relation, landed, self._y):
            lost["where the relation would not hold"] += 1
            return None
        if self._on_end and not self._stays(landed):
            lost["where it would topple out"] += 1
            return None
        clear = bool(least_gaps(landed.low[None], landed.high[None], self._beside, True)[0] >= request.epsilon_m)
        if not clear and not outlines_clear(landed, self._beside, request.epsilon_m, over_lower=True):
            lost[f"within {1e3 * request.epsilon_m:g} mm of something"] += 1
            return None
        offset = np.append(cells * request.cell, landed.low[2] - turn.body.low[2])
        clearance = WALL_CLEARANCE_M if self._into else RELEASE_M
        rise = self._pieces.rise(turn, offset, clearance)
        if rise > MAX_RISE_M:
            lost["where its convex pieces do not fit"] += 1
            return None
        clear_by = "boxes" if clear else "outlines"
        if self._into:
            return self._wall_gap(landed) < WALL_GAP_M, Place(turn, offset, self._drops(landed, rise), clear_by)
        # It will stand on pieces, which may lie higher than the mesh: in a plate, on a lid with a groove.
        higher = max(rise - clearance, 0.0)
        if not holds(request.relation, landed.moved((0, 0), higher), self._y):
            lost["where its convex pieces stand too high"] += 1
            return None
        return False, Place(turn, offset + np.array([0.0, 0.0, higher]), (clearance,), clear_by)

    def _stays(self, landed: BodyFeatures) -> bool:
        """Whether the centre of what is stood on its end lies below the rim, or it stands on the floor by itself."""
        cavity = self._y.cavity
        ground = self._heights[self._scene.window_of(landed.heights)]
        below = cavity is not None and float(landed.center[2]) < cavity.rim_z
        return below or stands(landed, landed.heights.bottom <= ground + CONTACT_M)

    def _wall_gap(self, landed: BodyFeatures) -> float:
        """Least way from the object's columns below the rim to the wall, by whole cells [m]."""
        cavity = self._y.cavity
        if cavity is None:
            return 0.0
        below = landed.heights.bottom < cavity.rim_z - RELEASE_M
        return float(landed.heights.window(self._y.heights, self._depth, 0.0)[below].min(initial=np.inf))

    def _drops(self, landed: BodyFeatures, least: float) -> tuple[float, ...]:
        """Down in the vessel, or with its top so high that fingers stay above the rim: first what suits its width."""
        cavity = self._y.cavity
        above = cavity.rim_z + FINGERS_M - float(landed.high[2]) if cavity is not None else 0.0
        if above <= least:
            return (least,)
        width = 2 * float(self._depth.max())
        wide = width >= float((landed.high - landed.low)[:2].min()) + 2 * HAND_ROOM_M
        return (least, above) if wide else (above, least)

    def _is_content(self, other: BodyFeatures) -> bool:
        """Whether a body lies in the vessel, or leans in it with its middle over the room."""
        index = np.floor(other.center[:2] / self._request.cell).astype(np.int64) - np.array(self._y.heights.corner)
        room = self._y.cavity.cells if self._y.cavity is not None else np.zeros((0, 0), dtype=bool)
        over = bool(((index >= 0) & (index < room.shape)).all()) and bool(room[tuple(index)])
        return over or (_box_gap(other, self._y) < 0.0 and is_inside(other, self._y))


def _box_gap(a: BodyFeatures, b: BodyFeatures) -> float:
    """Gap between boxes seen from above, along the axis on which they are furthest apart [m]."""
    return float(np.maximum(a.low - b.high, b.low - a.high)[:2].max())
