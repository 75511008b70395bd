"""Changes of an arrangement, drawn at random where there is room: nothing comes into another thing.

What is moved stays on the table; it grows where what is turned, greater or swapped in needs it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from schemas.cousins import Change
from schemas.geometry import Vector3
from schemas.objects import PlacedObject
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.physics.mjcf.slab import OBJECT_MARGIN_M
from tableverse_factory.stages.cousins.arrangement import Arrangement, Unit, move_object, place_object, scale_object

MOVE_GAP_M, TURN_GAP_M = 0.005, 0.001  # least distance to other things, of what is put elsewhere, and of what stays
LEAST_MOVE_M = 0.06
NEAR_M = 0.09  # greatest distance of what is moved to another thing: scenes whose groups lie further apart are unusable
LEAST_TURN_RAD = float(np.deg2rad(25.0))
SCALES = ((0.8, 0.92), (1.09, 1.25))
PLACES, HEADINGS = 60, 12  # that are tried for a thing
EDGE_M = 0.03  # least distance of a moved thing from the table's edge, where the table has no wider margin free
LIFT_M = 0.0005
ROUND = 0.06  # greatest difference of the outline's reach in different directions, over the reach
LEAST_CHANGES = 2
LEAST_LEFT = 2  # things of a scene that none is taken from
FILLING = (Change.MOVE, Change.SCALE, Change.TURN)
LARGEST_ON_OTHERS = 1.15  # sides of a thing over those of the one whose place on another it takes
_ANGLES = np.arange(16) * (2 * np.pi / 16)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_MORE = {Change.REMOVE: 0.15, Change.SWAP: 0.5, Change.SCALE: 0.3, Change.MOVE: 0.4, Change.TURN: 0.4}
"""Probability that a change is made to each further unit, besides the first."""


@dataclass(slots=True)
class Draft:
    """A cousin in the making: the arrangement, and what was changed.

    `donors` are names and readers of things that may come into it, by whom they replace.
    """

    arrangement: Arrangement
    rng: np.random.Generator
    donors: Mapping[str, Sequence[tuple[str, Callable[[], PlacedObject]]]]
    changes: list[str] = field(default_factory=list)
    _touched: dict[Change, set[str]] = field(default_factory=lambda: {change: set() for change in Change})

    def make(self, change: Change) -> None:
        """Make a change to some units: to at least one, if there is room for it anywhere."""
        units = self._list_units(change)
        wanted = 1 + int(self.rng.binomial(max(len(units) - 1, 0), _MORE[change]))
        while wanted and (unit := self._make_one(change, units)):
            self._touched[change] |= unit.members
            wanted -= 1
            units = self._list_units(change)  # what lay under the unit may be free now

    def _list_units(self, change: Change) -> list[Unit]:
        """List the units to which a change can be made, and was not made yet."""
        units = [unit for unit in self.arrangement.list_units() if unit.members.isdisjoint(self._touched[change])]
        return [unit for unit in units if _MAY[change](self, unit)]

    def _make_one(self, change: Change, units: Sequence[Unit]) -> Unit | None:
        """Make a change to the first unit, in random order, that has the room; None if there is none."""
        shuffled = (units[place] for place in self.rng.permutation(len(units)).tolist())
        return next((unit for unit in shuffled if _MAKE[change](self, unit)), None)

    def fill(self) -> None:
        """Make further changes until there are as many as make a scene another one, if there is room."""
        for change in FILLING:
            if len(self.changes) < LEAST_CHANGES:
                self.make(change)

    def members(self, unit: Unit) -> list[PlacedObject]:
        """The objects of a unit, in the order of the scene."""
        return [item for name, item in self.arrangement.objects.items() if name in unit.members]

    def record(self, change: Change, unit: Unit, value: str = "") -> None:
        """Write a change down, with all things that it was made to."""
        names = "+".join((unit.root, *sorted(unit.members - {unit.root})))
        self.changes.append(f"{change.value}:{names}" + (f"={value}" if value else ""))


def _may_remove(draft: Draft, unit: Unit) -> bool:
    """Whether nothing depends on a thing, and enough others are left."""
    return len(unit.members) == 1 and len(draft.arrangement.objects) > LEAST_LEFT


def _remove(draft: Draft, unit: Unit) -> bool:
    draft.arrangement.remove(unit.root)
    draft.record(Change.REMOVE, unit)
    return True


def _may_swap(draft: Draft, unit: Unit) -> bool:
    item = draft.arrangement.objects[unit.root]
    return len(unit.members) == 1 and item.contained_in is None and unit.root in draft.donors


def _swap(draft: Draft, unit: Unit) -> bool:
    old = draft.arrangement.objects[unit.root]
    low, high = aabb(place_object(old).points)
    carriers = draft.arrangement.find_supports(unit.members)
    for name, read in draft.donors[unit.root]:
        donor = read()
        if not draft.arrangement.stands_alone(donor):
            continue
        own_low, own_high = aabb(place_object(donor).points)
        if carriers and ((own_high - own_low)[:2].max() > LARGEST_ON_OTHERS * (high - low)[:2].max()):
            continue
        pivot = (own_low + own_high) / 2
        offset = (low + high) / 2 - pivot
        offset[2] = low[2] - own_low[2] + (LIFT_M if carriers else 0.0)
        for angle in draft.rng.uniform(-np.pi, np.pi, HEADINGS).tolist():
            placed = move_object(replace(donor, object_id=unit.root), pivot, offset, angle)
            if draft.arrangement.fits([placed], TURN_GAP_M, carriers):
                draft.arrangement.replace([placed])
                draft.record(Change.SWAP, unit, name)
                return True
    return False


def _scale(draft: Draft, unit: Unit) -> bool:
    """Scale a unit about where it stands: what it carries with it, so that it rests as before."""
    members, carriers = draft.members(unit), draft.arrangement.find_supports(unit.members)
    pivot = _find_foot(draft, unit)
    for k in draft.rng.permutation(len(SCALES)).tolist():
        factor = round(float(draft.rng.uniform(*SCALES[k])), 3)
        scaled = [scale_object(item, pivot, factor) for item in members]
        if draft.arrangement.fits(scaled, TURN_GAP_M, carriers):
            draft.arrangement.replace(scaled)
            draft.record(Change.SCALE, unit, f"{factor:g}")
            return True
    return False


def _turn(draft: Draft, unit: Unit) -> bool:
    members, pivot = draft.members(unit), _find_foot(draft, unit)
    for _ in range(HEADINGS):
        angle = float(draft.rng.uniform(LEAST_TURN_RAD, 2 * np.pi - LEAST_TURN_RAD))
        turned = [move_object(item, pivot, np.zeros(3), angle) for item in members]
        if draft.arrangement.fits(turned, TURN_GAP_M):
            draft.arrangement.replace(turned)
            draft.record(Change.TURN, unit, _format_angle(angle))
            return True
    return False


def _may_move(draft: Draft, unit: Unit) -> bool:
    item = draft.arrangement.objects[unit.root]
    return unit.stands or (item.contained_in is None and draft.arrangement.stands_alone(item))


def _move(draft: Draft, unit: Unit) -> bool:
    """Put a unit elsewhere on the table, in any heading: also what stood on another thing."""
    members, pivot = draft.members(unit), _find_foot(draft, unit)
    down = np.array([0.0, 0.0, 0.0 if unit.stands else -pivot[2]])
    for spot, margin in _list_places(draft, unit, pivot):
        angle = float(draft.rng.uniform(-np.pi, np.pi))
        moved = [move_object(item, pivot, spot + down, angle) for item in members]
        near = draft.arrangement.holds(moved, margin) and draft.arrangement.is_near(moved, NEAR_M)
        if near and draft.arrangement.fits(moved, MOVE_GAP_M):
            draft.arrangement.replace(moved, stands=not unit.stands)
            draft.record(Change.MOVE, unit, f"{spot[0]:+.3f},{spot[1]:+.3f}")
            return True
    return False


def _list_places(draft: Draft, unit: Unit, pivot: Vector3) -> Iterator[tuple[Vector3, float]]:
    """List offsets to random places around the other things, with the margin to keep from the table's edge [m]."""
    others = [name for name in draft.arrangement.objects if name not in unit.members]
    low, high = aabb(draft.arrangement.get_points(others or sorted(unit.members))[:, :2])
    own_low, own_high = aabb(draft.arrangement.get_points(sorted(unit.members))[:, :2])
    reach = NEAR_M + (own_high - own_low).max() / 2
    for number in range(2 * PLACES):
        offset = np.array([*(draft.rng.uniform(low - reach, high + reach) - pivot[:2]), 0.0])
        if np.linalg.norm(offset) >= LEAST_MOVE_M:
            yield offset, OBJECT_MARGIN_M if number < PLACES else EDGE_M


def _find_foot(draft: Draft, unit: Unit) -> Vector3:
    """Middle of a unit's root from above, at the height on which it stands [m]."""
    low, high = aabb(draft.arrangement.get_points([unit.root]))
    return np.array([*((low + high) / 2)[:2], low[2] if not unit.stands else 0.0])


def _format_angle(angle: float) -> str:
    degrees = np.rad2deg(angle)
    return f"{degrees - 360.0 if degrees > 180.0 else degrees:+.0f}"


def _may_turn(draft: Draft, unit: Unit) -> bool:
    """Whether a turn of the unit changes anything: it does not where the outline is round."""
    points = draft.arrangement.get_points(sorted(unit.members))[:, :2]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = ((points - middle) @ _DIRECTIONS).max(axis=0)
    return unit.stands and float(np.ptp(reach)) > ROUND * float(reach.max())


def _may_scale(draft: Draft, unit: Unit) -> bool:
    return unit.stands or draft.arrangement.objects[unit.root].contained_in is None


_MAY: Mapping[Change, Callable[[Draft, Unit], bool]] = {
    Change.REMOVE: _may_remove,
    Change.SWAP: _may_swap,
    Change.SCALE: _may_scale,
    Change.MOVE: _may_move,
    Change.TURN: _may_turn,
}
_MAKE: Mapping[Change, Callable[[Draft, Unit], bool]] = {
    Change.REMOVE: _remove,
    Change.SWAP: _swap,
    Change.SCALE: _scale,
    Change.MOVE: _move,
    Change.TURN: _turn,
}
