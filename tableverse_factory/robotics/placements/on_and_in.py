"""Placements on or in the reference: lowered from above on height maps until the object touches."""

from collections import Counter

import numpy as np
from scipy import ndimage

from schemas.curation import Relation
from schemas.geometry import Vector3
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep, MovingSolid
from tableverse_factory.geometry.collision.solids import Solids
from tableverse_factory.geometry.math.transforms import rotation_matrix, transform_points
from tableverse_factory.geometry.mesh.height_maps import Heights
from tableverse_factory.geometry.relations.relations import BodyFeatures, is_inside, relation_holds
from tableverse_factory.geometry.relations.stable_placement import CONTACT_M, drop_body, is_stable, make_support_surface
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.robotics.placements.clearance import are_outlines_clear, compute_least_gaps
from tableverse_factory.robotics.placements.orientations import Orientation
from tableverse_factory.robotics.placements.request import (
    RELEASE_HEIGHT_M,
    SAMPLES_PER_PLACEMENT,
    CandidatePlacement,
    NoPlacement,
    PlacementRequest,
    PlacementSamples,
)

FINGER_REACH_M = 0.02  # minimum reach of fingers beside a held object, from its top
HAND_ROOM_M = 0.05  # fingers may enter a vessel that is wider than the object by this on either side
WALL_CLEARANCE_M = 0.001  # gap between the convex pieces of an object released in a vessel and the vessel's
MAX_RISE_M = 0.012  # if pieces only clear this much higher than the meshes, a simulated object does not fit
WALL_GAP_M = 0.006  # gap to the wall that makes an insertion easy
_CORE_SHARE = 0.6  # share of the object's width that is used to find the ground
_LEVEL_SCALE_M = 0.03  # height in a vessel that costs as much as lying at its wall
_MAX_DEPTH_M = 0.05  # distance from the edge beyond which a placement is no better


def _build_solids(scene_object: SceneObject) -> Solids:
    return Solids(
        [transform_points(scene_object.pose, hull.vertices) for hull in scene_object.hulls],
        [h.faces for h in scene_object.hulls],
    )


def find_places_on_or_in(
    request: PlacementRequest, turns: tuple[Orientation, ...], rng: np.random.Generator, *, on_end: bool = False
) -> tuple[CandidatePlacement, ...] | NoPlacement:
    """Find up to `request.wanted` placements on or in the reference, best first.

    With `on_end` the object is stood on its end and must not topple out again.
    """
    y = request.y.body
    if request.relation is Relation.ON and not y.flat.any():
        return NoPlacement("no_stable_top", f"{request.y.object_id} has no level patch that carries anything")
    if request.relation is not Relation.ON and y.cavity is None:
        return NoPlacement("no_container", f"{request.y.object_id} has no room that opens upwards")
    return _ReferenceSurface(request, turns, on_end=on_end).find_places(rng)


class _ReferenceSurface:
    """The reference with nearby objects."""

    def __init__(self, request: PlacementRequest, turns: tuple[Orientation, ...], *, on_end: bool) -> None:
        self._request, self._turns, self._y, self._on_end = request, turns, request.y.body, on_end
        self._into = request.relation is not Relation.ON
        cavity = self._y.cavity if self._into else None
        self._rim_z = -np.inf if cavity is None else cavity.rim_z
        self._room = self._y.flat if cavity is None else cavity.cells
        size = max(float(np.linalg.norm((turn.body.high - turn.body.low)[:2])) for turn in turns)
        things = [o for o in request.others if _compute_box_gap(o.body, self._y) < size]
        near = tuple(o.body for o in things)
        self._solids = _build_solids(request.x)
        self._near = [MovingSolid(_build_solids(o), np.zeros(3)) for o in (request.y, *things)]
        self._rotated: dict[bytes, Solids] = {}
        self._up = LinearSweep(np.array([0.0, 0.0, 1.0]))
        # Contents lie where the object is to go: it is let down onto them, by the map; boxes would keep it out.
        self._beside = tuple(o for o in near if not (self._into and self._is_content(o)))
        self._scene = make_support_surface((self._y, *near), request.table, request.cell, size + 2 * request.cell)
        self._heights = self._scene.without(None)
        self._ground = self._heights[self._scene.window_of(self._y.heights)]
        free = self._room if self._into else self._room & (self._ground <= self._y.heights.top + CONTACT_M)
        self._depth: Heights = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * request.cell

    def find_places(self, rng: np.random.Generator) -> tuple[CandidatePlacement, ...] | NoPlacement:
        """Find where the object stands, or lies within the rim, clear of neighbors, and the relation holds."""
        count = -(-SAMPLES_PER_PLACEMENT * self._request.wanted // len(self._turns))
        parts = [self._sample_heading(turn, index, count, rng) for index, turn in enumerate(self._turns)]
        lost: Counter[str] = Counter()
        found = self._request.judge_samples(
            parts, lambda heading, cells, _: self._lower_object(self._turns[heading], cells, lost)
        )
        told = ", ".join(f"{many} {why}" for why, many in lost.items()) or "none over it"
        easy_first = sorted(found, key=lambda entry: entry[0])
        total = sum(len(part.costs) for part in parts)
        return tuple(place for _, place in easy_first) or NoPlacement("no_room", f"of {total} {told}")

    def _sample_heading(
        self, turn: Orientation, heading: int, count: int, rng: np.random.Generator
    ) -> PlacementSamples:
        """Sample placements whose deciding point is over the room: the center if it stands, the middle if it goes in.

        The deepest cell is always included, as random samples may miss a small room in a large box.
        """
        request, body, shape = self._request, turn.body, np.array(self._depth.shape)
        middle = (body.low + body.high)[:2] / 2
        counts = middle if self._into else body.center[:2]
        start = np.floor(counts / request.cell).astype(np.int64) - np.array(self._y.heights.corner)
        deepest = np.array(np.unravel_index(int(np.argmax(self._depth)), self._depth.shape))
        cells = np.concatenate([(deepest - start)[None], request.sample_cells(turn, count, rng)[0]])
        there = ((start + cells >= 0) & (start + cells < shape)).all(axis=1)
        cells = cells[there]
        index = tuple((start + cells).T)
        kept = self._depth[index] > 0.0
        level = self._estimate_level(body)[index][kept]
        offset = np.column_stack([cells[kept] * request.cell, level - body.low[2]])
        gap = compute_least_gaps(body.low + offset, body.high + offset, self._beside, over_lower=True)
        costs = 1.0 - np.minimum(self._depth[index][kept], _MAX_DEPTH_M) / _MAX_DEPTH_M + 0.5 * turn.angle / np.pi
        costs += (
            (level - level.min(initial=np.inf)) / _LEVEL_SCALE_M
            if self._into
            else 1.0 - np.clip(gap, 0, _MAX_DEPTH_M) / _MAX_DEPTH_M
        )
        heading_of = np.full(len(level), heading)
        return PlacementSamples(heading_of, cells[kept], middle + offset[:, :2], costs, gap >= request.epsilon_m)

    def _estimate_level(self, body: BodyFeatures) -> Heights:
        """Estimate the height of a body's lowest point over each cell of the reference."""
        if not self._into:
            return self._y.heights.top
        half = (body.high - body.low)[:2] / 2
        size = np.maximum(np.rint(_CORE_SHARE * half / self._request.cell).astype(int), 0) * 2 + 1
        return ndimage.maximum_filter(self._ground, size=tuple(size), mode="nearest")

    def _lower_object(
        self, turn: Orientation, cells: np.ndarray, lost: Counter[str]
    ) -> tuple[bool, CandidatePlacement] | None:
        """Lower the object at a sample; return the placement and whether it is tight, or None if rejected."""
        request = self._request
        by_cells = (int(cells[0]), int(cells[1]))
        landed = drop_body(request.relation, turn.body, by_cells, self._y, self._scene, self._heights)
        if landed is None:
            lost["where it would not fit or stand"] += 1
            return None
        if not relation_holds(request.relation, landed, self._y):
            lost["where the relation would not hold"] += 1
            return None
        if self._on_end and not self._is_stable(landed):
            lost["where it would topple out"] += 1
            return None
        gap = compute_least_gaps(landed.low[None], landed.high[None], self._beside, over_lower=True)[0]
        clear = bool(gap >= request.epsilon_m)
        if not clear and not are_outlines_clear(landed, self._beside, request.epsilon_m, over_lower=True):
            lost[f"within {1e3 * request.epsilon_m:g} mm of something"] += 1
            return None
        offset = np.append(cells * request.cell, landed.low[2] - turn.body.low[2])
        clearance = WALL_CLEARANCE_M if self._into else RELEASE_HEIGHT_M
        rise = self._find_clear_height(turn, offset, clearance)
        if rise > MAX_RISE_M:
            lost["where its convex pieces do not fit"] += 1
            return None
        clear_by = "boxes" if clear else "outlines"
        if self._into:
            place = CandidatePlacement(turn, offset, self._list_drop_heights(landed, rise), clear_by)
            return self._compute_wall_gap(landed) < WALL_GAP_M, place
        # It will stand on pieces, which may lie higher than the mesh: in a plate, on a lid with a groove.
        higher = max(rise - clearance, 0.0)
        if not relation_holds(request.relation, landed.moved((0, 0), higher), self._y):
            lost["where its convex pieces stand too high"] += 1
            return None
        return False, CandidatePlacement(turn, offset + np.array([0.0, 0.0, higher]), (clearance,), clear_by)

    def _find_clear_height(self, turn: Orientation, offset: Vector3, clearance_m: float) -> float:
        """Find exactly how far above `offset` the turned pieces first have `clearance_m` to all others [m]."""
        key = turn.quaternion_wxyz.tobytes()
        if key not in self._rotated:
            self._rotated[key] = self._solids.turned(rotation_matrix(turn.quaternion_wxyz), np.zeros(3))
        return self._up.find_first_clear([MovingSolid(self._rotated[key], offset)], self._near, clearance_m)

    def _is_stable(self, landed: BodyFeatures) -> bool:
        """Test whether an object on its end has its center below the rim, or stands on the floor by itself."""
        ground = self._heights[self._scene.window_of(landed.heights)]
        return float(landed.center[2]) < self._rim_z or is_stable(landed, landed.heights.bottom <= ground + CONTACT_M)

    def _compute_wall_gap(self, landed: BodyFeatures) -> float:
        """Compute the least distance from the object below the rim to the wall, in whole cells [m]."""
        below = landed.heights.bottom < self._rim_z - RELEASE_HEIGHT_M
        return float(landed.heights.window(self._y.heights, self._depth, 0.0)[below].min(initial=np.inf))

    def _list_drop_heights(self, landed: BodyFeatures, least: float) -> tuple[float, ...]:
        """List release heights: low in the vessel, or with fingers above the rim, in the order that suits its width."""
        above = self._rim_z + FINGER_REACH_M - float(landed.high[2])
        if above <= least:
            return (least,)
        width = 2 * float(self._depth.max())
        wide = width >= float((landed.high - landed.low)[:2].min()) + 2 * HAND_ROOM_M
        return (least, above) if wide else (above, least)

    def _is_content(self, other: BodyFeatures) -> bool:
        """Test whether a body lies in the vessel, or leans in it with its middle over the room."""
        index = np.floor(other.center[:2] / self._request.cell).astype(np.int64) - np.array(self._y.heights.corner)
        over = bool(((index >= 0) & (index < self._room.shape)).all()) and bool(self._room[tuple(index)])
        return over or (_compute_box_gap(other, self._y) < 0.0 and is_inside(other, self._y))


def _compute_box_gap(a: BodyFeatures, b: BodyFeatures) -> float:
    """Compute the gap between boxes seen from above, along the axis of largest separation [m]."""
    return float(np.maximum(a.low - b.high, b.low - a.high)[:2].max())
