"""Start poses for dropping an object into a container, and the budget of a scene for that."""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import ConvexPieces, Frozen, Points, Pose, TriangleMesh, Vector3
from schemas.objects import PlacedObject
from tableverse_factory.geometry.collision.linear_sweep import ClearSearch, LinearSweep, MovingSolid
from tableverse_factory.geometry.collision.solids import place_pieces
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    normalize_quaternion,
    quaternion_about_z,
    rotation_matrix,
    transform_points,
    translate_pose,
)
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.containers import HollowVessel
from tableverse_factory.physics.mjcf.spec import SceneBody
from tableverse_factory.stages.rectify.vertical import UP

HEADINGS = 8  # sideways directions in which an object that overlaps is pushed clear; as many again point halfway up
TILT_STEPS = (0.15, 0.3, 0.5)  # shares by which a long object is turned upright, where pushing would move it far
LONG_RATIO = 2.5
METRES_PER_RAD = 0.05  # cost of turning an object against pushing it
DRAWS = 16  # random poses tried for one fall; the one that starts lowest is taken
BUDGET_SPENT = "filling the containers of this scene took as much work as it may"


@dataclass(slots=True)
class SimulationBudget:
    """Remaining budget of a scene, in work, not in seconds, so that results repeat; all that was started is finished.

    Attributes:
        dropping_s: Simulated time for dropping contents one by one [s].
        freeing_s: Simulated time for settling the contents together [s]; separate, so that dropping cannot exhaust it.
        comparisons: Of two convex pieces each, to find a free start for a fall.
    """

    dropping_s: float = 60.0
    freeing_s: float = 60.0
    comparisons: int = 24_000_000

    @property
    def may_drop(self) -> bool:
        """Whether another object may be dropped."""
        return self.dropping_s > 0.0 and self.comparisons > 0


@dataclass(frozen=True, slots=True, eq=False)
class CompositeMember(Frozen):
    """One object of a composite: as it was placed, its pieces, and its simulation body at the current pose."""

    item: PlacedObject
    pieces: ConvexPieces
    body: SceneBody

    @property
    def container_id(self) -> str:
        """Its container; empty for the outermost one."""
        return self.item.contained_in or ""

    @property
    def pose(self) -> Pose:
        """Current pose."""
        return self.body.pose

    @property
    def mesh(self) -> TriangleMesh:
        """Its mesh at the current pose."""
        return place_mesh(self.item.mesh, self.pose, self.item.scale)

    @property
    def corners(self) -> Points:
        """Corners of its pieces at the current pose [m]. Shape (n, 3)."""
        return transform_points(self.pose, np.concatenate([hull.vertices for hull in self.body.hulls]))

    @property
    def solid(self) -> MovingSolid:
        """Its pieces at the current pose."""
        uncovered = self.item.scale * self.pieces.uncovered_m
        return MovingSolid(place_pieces(self.pieces, self.pose, self.item.scale), np.zeros(3), uncovered)

    def at(self, pose: Pose) -> "CompositeMember":
        """Put it at another pose."""
        return replace(self, body=replace(self.body, pose=pose))


class Surroundings:
    """Fixed bodies from which a falling one keeps a clearance [m]; each search is charged to the budget."""

    def __init__(self, fixed: Sequence[MovingSolid], clearance_m: float, budget: SimulationBudget) -> None:
        self._fixed, self._clearance_m, self.budget = fixed, clearance_m, budget
        self._pieces = sum(len(body.solids.starts) for body in fixed)

    def search(self, member: CompositeMember, solid: MovingSolid, direction: Vector3) -> ClearSearch:
        """Search how far an object, with its pieces, must be pushed in a direction (unit vector) to be clear."""
        self.budget.comparisons -= len(member.body.hulls) * self._pieces
        return LinearSweep(direction).search([solid], self._fixed, self._clearance_m)

    def raised(self, member: CompositeMember) -> CompositeMember:
        """Raise an object until it is clear."""
        search = self.search(member, member.solid, UP)
        while not search.done:
            search.advance()
        return _push(member, search.d, UP)


def _push(member: CompositeMember, way: float, direction: Vector3) -> CompositeMember:
    return member.at(translate_pose(member.pose, way * direction))


@dataclass(slots=True)
class _Push:
    """An object turned by `angle` [rad], and the search for how far it must be pushed in a direction."""

    turned: CompositeMember
    angle: float
    direction: Vector3
    search: ClearSearch

    @property
    def cost(self) -> float:
        """Lower bound of what the start deviates from the seen pose, exact once the search is done [m]."""
        return self.search.d + METRES_PER_RAD * self.angle

    def advance(self) -> None:
        """Go on until the cost is higher or exact."""
        before = self.search.d
        while not self.search.done and self.search.d == before:
            self.search.advance()


def find_seen_starts(member: CompositeMember, around: Surroundings, holder: HollowVessel) -> Iterator[CompositeMember]:
    """Find starts for a seen object: its pose, else pushed clear as little as possible, long objects also more upright.

    Only starts over or in the container are given, the nearest first, and as many as the budget allows. No search goes
    on beyond the cost of the last start that was asked for.
    """
    pushes = list(_list_pushes(member, around))
    waiting = [(push.cost, k) for k, push in enumerate(pushes)]
    heapq.heapify(waiting)
    while waiting:
        _, k = heapq.heappop(waiting)
        push = pushes[k]
        if not push.search.done:
            push.advance()
            heapq.heappush(waiting, (push.cost, k))
        elif holder.holds((start := _push(push.turned, push.search.d, push.direction)).mesh):
            yield start


def _list_pushes(member: CompositeMember, around: Surroundings) -> Iterator[_Push]:
    """List the pushes to try, as many as the budget allows: one where the object is clear as it was seen."""
    for turned, angle in _tilt_upright(member):
        solid = turned.solid
        for direction in _list_push_directions():
            if not around.budget.may_drop:
                return
            push = _Push(turned, angle, direction, around.search(turned, solid, direction))
            push.advance()
            yield push
            if push.search.done and push.search.d == 0.0:
                if direction is UP and turned is member:
                    return
                break


def draw_random_start(
    member: CompositeMember, around: Surroundings, holder: HollowVessel, rng: np.random.Generator
) -> CompositeMember:
    """Draw a start over the container's room, at the lowest free height of the best of `DRAWS` draws.

    Every other draw keeps the object's orientation but for its heading; the rest have any orientation.
    """
    draws = [_draw_start(member, holder, k % 2 == 1, rng) for k in range(DRAWS)]
    raised = [around.raised(start) for start in draws]
    return min(raised, key=lambda member: sum(corner[2] for corner in aabb(member.corners)))


def _draw_start(
    member: CompositeMember, holder: HollowVessel, anyhow: bool, rng: np.random.Generator
) -> CompositeMember:
    """Put the member over a random cell of the room, its lowest point on the floor."""
    heights = holder.body.heights
    cells = np.argwhere(holder.room)
    at = (cells[int(rng.integers(len(cells)))] + heights.corner + rng.random(2)) * heights.cell
    free = normalize_quaternion(rng.normal(size=4))
    heading = quaternion_about_z(float(rng.uniform(0.0, 2 * np.pi)))
    turn = free if anyhow else multiply_quaternions(heading, member.pose.quaternion_wxyz)
    turned = member.at(Pose(np.zeros(3), normalize_quaternion(turn)))
    low, high = aabb(turned.corners)
    middle = (low + high) / 2
    return turned.at(Pose(np.array([*(at - middle[:2]), holder.floor_z - low[2]]), turned.pose.quaternion_wxyz))


def _tilt_upright(member: CompositeMember) -> Iterator[tuple[CompositeMember, float]]:
    """Yield the object, and where it is long, tilts of it towards upright, with the angle [rad]."""
    yield member, 0.0
    corners = member.corners
    middle = corners.mean(axis=0)
    _, spread, axes = np.linalg.svd(corners - middle, full_matrices=False)
    if spread[0] < LONG_RATIO * spread[1]:
        return
    axis = axes[0] if axes[0, 2] >= 0.0 else -axes[0]
    tilt = float(np.arccos(np.clip(axis[2], -1.0, 1.0)))
    across = np.cross(axis, UP)
    if np.linalg.norm(across) < 1e-6:
        return
    for share in TILT_STEPS:
        half = share * tilt / 2
        turn = np.concatenate([[np.cos(half)], np.sin(half) * (across / np.linalg.norm(across))])
        pose = member.pose
        position = rotation_matrix(turn) @ (pose.position - middle) + middle
        turned = Pose(position, normalize_quaternion(multiply_quaternions(turn, pose.quaternion_wxyz)))
        yield member.at(turned), share * tilt


def _list_push_directions() -> list[np.ndarray]:
    level = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(HEADINGS) * (2 * np.pi / HEADINGS)]
    return [UP, *level, *((flat + UP) / np.sqrt(2.0) for flat in level)]
