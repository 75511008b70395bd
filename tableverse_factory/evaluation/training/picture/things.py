"""Things that stand about freely: boxes, cans, shapes of several parts, and the generator's meshes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tableverse_factory.evaluation.training.picture.tables import MeshTables

MAX_LEVELS = 3  # of a stack
MAX_STACK_M = 0.55
PUSH_M = 0.006


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A mesh under an affine map: `map_` and `offset` take its own frame to the thing's."""

    mesh: int
    map_: np.ndarray  # Shape (3, 3)
    offset: np.ndarray  # [m]
    own_material: bool = False  # rather than that of the first part
    printed: float = 0.35  # chance of a printed texture


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """Parts about a foot at the origin, half extents there [m], height [m], and whether another can stand on it."""

    parts: tuple[Part, ...]
    half: tuple[float, float]
    height: float
    flat: bool


@dataclass(frozen=True, slots=True, eq=False)
class StandingThing:
    """A thing at a place of the table [m], turned about z, its foot at height `z` [m]."""

    thing: Thing
    place: np.ndarray
    yaw: float
    z: float

    def list_parts(self) -> list[Part]:
        """Move the parts to the table's frame."""
        turn, shift = make_turn(2, self.yaw), np.array([*self.place, self.z])
        return [
            Part(part.mesh, turn @ part.map_, turn @ part.offset + shift, part.own_material, part.printed)
            for part in self.thing.parts
        ]


def make_turn(axis: int, angle: float) -> np.ndarray:
    """Make the rotation about an axis [rad]. Shape (3, 3)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = np.cos(angle)
    turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
    return turn


class ThingMaker:
    """Draws things from the shapes, and from those meshes of the generator that `pool` lists."""

    def __init__(self, tables: MeshTables, pool: Sequence[int]) -> None:
        self._tables = tables
        self._pool = pool
        self._box = tables.find("box")[0]
        self._cylinders = tables.find("cylinder", "cone")
        self._round = tables.find("lathe", "blob", "cylinder", "cone")
        self._odd = tables.find("cushion", "prism", "lathe", "blob")
        self._handles = tables.find("handle")
        self._makers: tuple[tuple[float, Callable[[np.random.Generator], Thing]], ...] = (
            (0.2, self._make_box),
            (0.22, self._make_large_box),
            (0.1, self._make_can),
            (0.12, self._make_odd),
            (0.12, self._make_handled),
            (0.1, self._make_capped),
            (0.1, self._make_composite),
            (0.16 if len(pool) else 0.0, self._make_generated),
        )
        self._weights = np.array([weight for weight, _ in self._makers])

    def make(self, rng: np.random.Generator) -> Thing:
        """Make a thing of a random kind."""
        index = int(rng.choice(len(self._makers), p=self._weights / self._weights.sum()))
        return self._makers[index][1](rng)

    def _make_box(self, rng: np.random.Generator) -> Thing:
        size = np.sort(np.exp(rng.uniform(np.log([0.015, 0.04, 0.07]), np.log([0.09, 0.17, 0.28]))))
        return self._box_of(size[rng.permutation(3)] if rng.random() < 0.75 else size[[2, 1, 0]], 0.5)

    def _make_large_box(self, rng: np.random.Generator) -> Thing:
        size = rng.uniform([0.05, 0.12, 0.16], [0.16, 0.26, 0.36])
        return self._box_of(size[rng.permutation(3)], 0.85)

    def _box_of(self, size: np.ndarray, printed: float) -> Thing:
        part = Part(self._box, np.diag(size), np.zeros(3), printed=printed)
        return Thing((part,), (size[0] / 2, size[1] / 2), float(size[2]), flat=True)

    def _make_can(self, rng: np.random.Generator) -> Thing:
        width, height = rng.uniform(0.03, 0.13), rng.uniform(0.03, 0.26)
        mesh = self._cylinders[int(rng.random() < 0.2)]
        if rng.random() < 0.25:  # it lies
            lying = make_turn(0, np.pi / 2) @ np.diag([width, width, height])
            part = Part(mesh, lying, np.array([0, height / 2, width / 2]), printed=0.5)
            return Thing((part,), (width / 2, height / 2), width, flat=False)
        part = Part(mesh, np.diag([width, width, height]), np.zeros(3), printed=0.5)
        return Thing((part,), (width / 2, width / 2), height, flat=True)

    def _make_odd(self, rng: np.random.Generator) -> Thing:
        mesh = self._odd[int(rng.integers(len(self._odd)))]
        size = np.exp(rng.uniform(np.log(0.04), np.log(0.2), 3))
        kind = self._tables.kinds[mesh]
        if kind == "lathe":
            size[1] = size[0]
        part = Part(mesh, np.diag(size), np.zeros(3))
        return Thing((part,), (size[0] / 2, size[1] / 2), float(size[2]), flat=kind == "prism")

    def _make_handled(self, rng: np.random.Generator) -> Thing:
        """Make a jug, mug, iron or bag: a body with one handle, often of its own colour."""
        mesh = self._round[int(rng.integers(len(self._round)))] if rng.random() < 0.75 else self._box
        width, height = rng.uniform(0.05, 0.15), rng.uniform(0.05, 0.24)
        body = Part(mesh, np.diag([width, width * rng.uniform(0.8, 1.0), height]), np.zeros(3))
        handle = self._handles[int(rng.integers(len(self._handles)))]
        own = bool(rng.random() < 0.4)
        if rng.random() < 0.75:  # at its side
            reach, rise = rng.uniform(0.02, 0.06), height * rng.uniform(0.4, 0.8)
            size = np.diag([reach, rng.uniform(0.008, 0.02), rise])
            place = np.array([width * rng.uniform(0.42, 0.5) + reach / 2, 0, (height - rise) * rng.uniform(0.2, 0.9)])
            turn = make_turn(2, rng.uniform(0, 2 * np.pi))
            parts = (body, Part(handle, turn @ size, turn @ place, own))
            half = width / 2 + reach
            return Thing(parts, (half, half), height, flat=False)
        rise = rng.uniform(0.03, 0.09)  # above it
        arch = make_turn(1, -np.pi / 2) @ np.diag([rise, rng.uniform(0.008, 0.025), width * rng.uniform(0.5, 0.9)])
        place = np.array([0, 0, height + 0.4 * rise]) - arch @ np.array([0, 0, 0.5])
        return Thing((body, Part(handle, arch, place, own)), (width / 2, width / 2), height + rise, flat=False)

    def _make_capped(self, rng: np.random.Generator) -> Thing:
        """Make a bottle, tube or jar: a body and a cap of its own colour."""
        width, height = rng.uniform(0.035, 0.1), rng.uniform(0.06, 0.24)
        mesh = self._round[int(rng.integers(len(self._round)))]
        neck = width * rng.uniform(0.3, 1.04)
        tall = rng.uniform(0.012, 0.06)
        body = Part(mesh, np.diag([width, width, height]), np.zeros(3), printed=0.5)
        shape = self._cylinders[int(rng.integers(len(self._cylinders)))]
        cap = Part(shape, np.diag([neck, neck, tall]), np.array([0, 0, height * 0.985]), own_material=True, printed=0.1)
        return Thing((body, cap), (width / 2, width / 2), height + tall, flat=False)

    def _make_composite(self, rng: np.random.Generator) -> Thing:
        """Make a tool or toy: two to four parts that overlap."""
        base = np.exp(rng.uniform(np.log(0.03), np.log(0.12), 3))
        parts: list[Part] = []
        half, height = np.zeros(2), 0.0
        options = [self._box, *self._odd]
        for index in range(int(rng.integers(2, 5))):
            size = base * rng.uniform(0.4, 1.3, 3)
            aside = rng.uniform(-0.6, 0.6, 2) * base[:2] if index else np.zeros(2)
            place = np.array([*aside, height * rng.uniform(0, 0.85)])
            mesh = options[int(rng.integers(len(options)))]
            parts.append(Part(mesh, np.diag(size), place, bool(rng.random() < 0.6)))
            height = max(height, float(place[2] + size[2]))
            half = np.maximum(half, np.abs(aside) + size[:2] / 2)
        return Thing(tuple(parts), (float(half[0]), float(half[1])), height, flat=False)

    def _make_generated(self, rng: np.random.Generator) -> Thing:
        """Take a mesh of the generator, upright or on its side."""
        mesh = self._pool[int(rng.integers(len(self._pool)))]
        turn = np.eye(3) * rng.uniform(0.85, 1.25)
        corners = np.stack([self._tables.low[mesh], self._tables.high[mesh]])
        lies = rng.random() < 0.2 and np.ptp(corners[:, 2]) > 0.06
        if lies:
            turn = make_turn(0, np.pi / 2) @ turn
        ends = corners @ turn.T
        low, high = ends.min(axis=0), ends.max(axis=0)
        middle = (low + high) / 2
        part = Part(mesh, turn, np.array([-middle[0], -middle[1], -low[2]]))
        half = (high - low) / 2
        return Thing((part,), (float(half[0]), float(half[1])), float(2 * half[2]), flat=False)


def arrange_things(rng: np.random.Generator, maker: ThingMaker, count: int) -> list[StandingThing]:
    """Stand things about the origin without collision, some stacked, many pushed together until they touch."""
    spread, stacking = rng.uniform(0.05, 0.13) * np.sqrt(count + 0.6), rng.uniform(0, 0.6)
    standing: list[StandingThing] = []
    ground: list[_Footprint] = []
    tops: list[tuple[_Footprint, float, int]] = []  # footprint, height, level
    for _ in range(count):
        thing = maker.make(rng)
        aligned = rng.random() < 0.3
        yaw = rng.normal(0, 0.06) + rng.integers(4) * np.pi / 2 if aligned else rng.uniform(0, 2 * np.pi)
        if tops and rng.random() < stacking:
            below, z, level = tops[int(rng.integers(len(tops)))]
            fits = min(thing.half) < 1.25 * max(below.half) and level < MAX_LEVELS
            if fits and z + thing.height < MAX_STACK_M:
                tops = [top for top in tops if top[0] is not below]
                own = _stand_on(rng, thing, below, yaw)
                standing.append(StandingThing(thing, own.place, own.yaw, z))
                if thing.flat:
                    tops.append((own, z + thing.height, level + 1))
                continue
        footprint = _find_room(rng, thing, yaw, spread, ground)
        if footprint is None:
            continue
        ground.append(footprint)
        standing.append(StandingThing(thing, footprint.place, yaw, 0.0))
        if thing.flat:
            tops.append((footprint, thing.height, 1))
    return standing


@dataclass(frozen=True, slots=True, eq=False)
class _Footprint:
    place: np.ndarray
    yaw: float
    half: tuple[float, float]

    def touches(self, other: "_Footprint") -> bool:
        """Whether two rectangles overlap (separating axes)."""
        apart = other.place - self.place
        if apart @ apart > (np.hypot(*self.half) + np.hypot(*other.half)) ** 2:
            return False
        axes = [(one, k) for one in (self, other) for k in (0, 1)]
        for one, k in axes:
            angle = one.yaw + k * np.pi / 2
            axis = np.array([np.cos(angle), np.sin(angle)])
            if abs(apart @ axis) > self._reach(axis) + other._reach(axis):
                return False
        return True

    def _reach(self, axis: np.ndarray) -> float:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return float(self.half[0] * abs(axis @ [c, s]) + self.half[1] * abs(axis @ [-s, c]))


def _stand_on(rng: np.random.Generator, thing: Thing, below: _Footprint, yaw: float) -> _Footprint:
    shift = rng.uniform(-0.45, 0.45, 2) * below.half
    place = make_turn(2, below.yaw)[:2, :2] @ shift + below.place
    if rng.random() < 0.6:
        yaw = below.yaw + rng.normal(0, 0.15) + rng.integers(4) * np.pi / 2
    return _Footprint(place, yaw, thing.half)


def _find_room(
    rng: np.random.Generator, thing: Thing, yaw: float, spread: float, ground: list[_Footprint]
) -> _Footprint | None:
    gap = rng.uniform(0, 0.03) if rng.random() < 0.7 else 0.0008
    half = (thing.half[0] + gap / 2, thing.half[1] + gap / 2)
    found = None
    for _ in range(25):
        trial = _Footprint(rng.normal(0, spread, 2), yaw, half)
        if not any(trial.touches(other) for other in ground):
            found = trial
            break
    if found is None or rng.random() < 0.5:
        return found
    inward = -found.place / max(float(np.linalg.norm(found.place)), 1e-6)
    for _ in range(40):  # push it towards the middle until it touches
        moved = _Footprint(found.place + inward * PUSH_M, yaw, half)
        if moved.place @ inward > 0 or any(moved.touches(other) for other in ground):
            break
        found = moved
    return found
