"""Least motion that frees a layout of collisions: a sequence of least-distance problems for each cluster of objects."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tableverse_factory.core.errors import SolverError
from tableverse_factory.geometry.collision.ldp_solver import SolverEffort, WorkLimitError, solve_balanced_motion
from tableverse_factory.geometry.collision.linear_sweep import MIN_MARGIN_M
from tableverse_factory.geometry.collision.separating_planes import PlaneFinder, PosedPieces, SeparatingPlane
from tableverse_factory.geometry.math.transforms import cross_matrix, quaternion_from_rotation_vector, rotation_matrix
from tableverse_factory.stages.rectify.fault_check import are_near
from tableverse_factory.stages.rectify.groups import connect_components
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import ON_TABLE_M, SupportRelation
from tableverse_factory.stages.rectify.untangle import release_parts

State = Float64[np.ndarray, "n 6"]  # of each part, translation [m] and rotation vector about its centre of mass [rad]
Planes = list[tuple[int, int, SeparatingPlane]]  # planes between two parts each
Rows = Float64[np.ndarray, "m k"]
Bounds = Float64[np.ndarray, " m"]
Constraints = tuple[Rows, Bounds, Int64[np.ndarray, " m"]]  # `rows @ state >= bounds`, and which belong together

Cluster = tuple[int, ...]  # indices of parts, ascending
Effort = tuple[SolverEffort, SolverEffort]  # left for all clusters: for least-distance problems, and for ways out

LINK_M = 0.01  # objects with a gap of at most this are in one cluster from the start [m]
# Motions of these sizes weigh the same, about the noise of registration; and the most along or about each axis in one
# step, the trust region [m, rad].
NOISE = np.array([0.007, 0.007, 0.003, np.radians(1.0), np.radians(1.0), np.radians(4.0)])
MAX_STEP = np.array([0.006] * 3 + [np.radians(2.0)] * 3)
# Pairs of pieces further apart are left out of a step [m]. Two parts may close 21 mm in one and collide: the next step
# separates them, and after the last one the exact clean-up does.
REACH_M = 0.012
WISHED_REACH_M = 0.025  # the same for a part and its carrier, which noise may have moved this far apart [m]
STEPS, LAST_STEPS = 10, 5
MAX_WORK = 3e9  # of a layout, in constraints times unknowns squared: thirty times that of ten objects in one place
MAX_ENTRIES = 2e7  # corners near planes times unknowns of a step, at most: 160 MB; ten boxes in one place have 2e4
MAX_WAYS_OUT = 5000  # entangled pairs times parts of a layout: some seconds; a dozen objects have at most 800
CONVERGED = 2e-5
PATIENCE, STUCK_M = 4, 2e-4  # pairs that still overlap this much after this many steps are entangled [m]
EXTRA_M = 2e-6  # added to the clearance, so that the exact clean-up has nothing to do [m]
CONTACT_M = 0.0005  # deviation of a wished contact that costs as much as a motion by the noise [m]
SOFTNESS = 0.05  # overlap left, in `UNIT`, that costs as much as a motion by the noise, where constraints contradict
TILTS = (0.05, 0.15)  # the lowest points are searched in directions this far from straight down [rad]
UPWARD = 0.3  # least vertical part of the normal of a wished contact
UNIT = 1e-3  # unit of the constraints, so that all numbers are near one [m]


def make_effort() -> Effort:
    """Make the budget of a layout."""
    return SolverEffort(MAX_WORK), SolverEffort(MAX_WAYS_OUT)


def relax_layout(
    parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float, effort: Effort
) -> tuple[list[RigidPart], set[int]]:
    """Find the least motion of every cluster, where those that would meet are joined; standing parts are upright.

    All spend from one budget, the smallest first, so that a heap does not use up what the others need. Returns the
    parts, and which of them have not been moved because the least motion of their cluster is too much work or was not
    found.
    """
    pairs = set(support.pairs) | _find_near_pairs(parts, [(i,) for i in range(len(parts))], LINK_M)
    known: dict[Cluster, list[RigidPart] | None] = {}
    while True:
        moved, solved = list(parts), []
        for cluster in sorted(connect_components(sorted(pairs), len(parts)), key=lambda found: (len(found), found)):
            if cluster not in known:
                known[cluster] = _relax_cluster(parts, cluster, support, clearance_m, effort)
            ended = known[cluster]
            if ended is not None:
                solved.append(cluster)
                for i, part in zip(cluster, ended, strict=True):
                    moved[i] = part
        met = _find_near_pairs(moved, solved, clearance_m)
        if not met:
            return moved, set(range(len(parts))) - {i for cluster in solved for i in cluster}
        pairs |= met


def _relax_cluster(
    parts: Sequence[RigidPart], cluster: Cluster, support: SupportRelation, clearance_m: float, effort: Effort
) -> list[RigidPart] | None:
    own = [parts[i] for i in cluster]
    if len(own) == 1:
        return own
    try:
        return Relaxation(own, support.of(cluster), clearance_m, effort).result()
    except SolverError:
        return None


def _find_near_pairs(parts: Sequence[RigidPart], clusters: Sequence[Cluster], reach_m: float) -> set[tuple[int, int]]:
    return {(i, j) for a, b in combinations(clusters, 2) for i in a for j in b if are_near(parts[i], parts[j], reach_m)}


class Relaxation:
    """Steps from the seen layout to the nearest collision-free one.

    Each minimises the motion from the seen layout, weighted by the noise, and the gaps of wished contacts, such
    that every pair of pieces stays separated, no part is below the table, and each stays in its trust region.
    """

    def __init__(
        self, parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float, effort: Effort
    ) -> None:
        self._parts, self._support = parts, support
        self._clearance = clearance_m + EXTRA_M
        self._separator = PlaneFinder()
        self._effort, self._effort_of_ways = effort
        self._noise = np.tile(NOISE, len(parts))
        self._pivots = np.array([part.mass_center_now for part in parts])
        self._lowest = {i: _find_lowest_points(part) for i, part in enumerate(parts) if not support.standing[i]}

    def result(self) -> list[RigidPart]:
        """Run the steps; the result is free of overlaps unless they ran out.

        The last steps only translate: then pairs that have a plane are apart, not only to first order. A step without
        a solution changes nothing: entangled parts may be released before the next.

        Raises:
            SolverError: if it is too much work, too much is entangled, or the last step had no solution.
        """
        at: State = np.zeros((len(self._parts), 6))
        unsolved: SolverError | None = None
        for turning, steps in ((True, STEPS), (False, LAST_STEPS)):
            free = self._free_axes(turning)
            for step in range(steps):
                planes = self._planes(at)
                if turning and step == PATIENCE:
                    at, planes = self._untangled(at, planes)
                try:
                    after, unsolved = self._step(at, planes, free), None
                except WorkLimitError:
                    raise
                except SolverError as error:
                    after, unsolved = at, error
                violation = max((-plane.spare_m for _, _, plane in planes), default=0.0)
                done = violation <= CONVERGED and np.abs(after - at).max() <= CONVERGED
                at = after
                if done:
                    break
        if unsolved is not None:
            raise unsolved
        return self._placed(at)

    def _placed(self, at: State) -> list[RigidPart]:
        return [part.turned(state[3:]).moved(state[:3]) for part, state in zip(self._parts, at, strict=True)]

    def _untangled(self, at: State, planes: Planes) -> tuple[State, Planes]:
        """Move entangled parts the shortest way out; returns the state and its planes."""
        stuck = sorted({(i, j) for i, j, plane in planes if plane.spare_m < -STUCK_M})
        if not stuck:
            return at, planes
        self._effort_of_ways.spend(len(stuck) * len(at), f"{len(stuck)} entangled pairs of {len(at)} parts")
        before = self._placed(at)
        after = release_parts(before, self._support, stuck, self._clearance)
        free = at.copy()
        free[:, :3] += [new.body.offset - old.body.offset for new, old in zip(after, before, strict=True)]
        return free, self._planes(free)

    def _free_axes(self, turning: bool) -> Bool[np.ndarray, " n"]:
        """Mark the free axes: standing parts keep their height and tilt."""
        free = np.ones((len(self._parts), 6), dtype=bool)
        free[:, [2, 3, 4]] = ~np.array(self._support.standing)[:, None]
        if not turning:
            free[:, 3:] = False
        return free.ravel()

    def _planes(self, at: State) -> Planes:
        stances = [self._stance(i, state) for i, state in enumerate(at)]
        found: Planes = []
        for i, j in combinations(range(len(stances)), 2):
            spare = self._parts[i].body.uncovered_m + self._parts[j].body.uncovered_m
            margin = max(self._clearance + spare, MIN_MARGIN_M)
            pair, rise = (stances[i], stances[j]), self._support.rise(i, j)
            planes = list(self._separator.planes(*pair, margin, REACH_M, rise))
            if rise and not planes:
                planes = list(self._separator.planes(*pair, margin, WISHED_REACH_M, rise))
            found.extend((i, j, plane) for plane in planes)
        return found

    def _stance(self, i: int, state: Float64[np.ndarray, "6"]) -> PosedPieces:
        rotation = rotation_matrix(quaternion_from_rotation_vector(state[3:]))
        body, pivot = self._parts[i].body, self._pivots[i]
        return PosedPieces(body.solids, rotation, rotation @ (body.offset - pivot) + pivot + state[:3])

    def _step(self, at: State, planes: Planes, free: Bool[np.ndarray, " n"]) -> State:
        """Find the state nearest to the seen layout that all linearised planes allow."""
        corners = sum(len(plane.points) for _, _, plane in planes)
        if corners * at.size > MAX_ENTRIES:
            raise WorkLimitError(f"{corners} corners of {len(at)} parts are near planes")
        blocks = zip(self._apart_and_on_table(at, planes), self._trusted(at), strict=True)
        rows, bounds, owners = (np.concatenate(block) for block in blocks)
        rows, bounds = rows / UNIT, bounds / UNIT
        wishes, wished = self._wishes(at, planes)
        fixed = at.ravel()[~free]
        bounds, wished = bounds - rows[:, ~free] @ fixed, wished - wishes[:, ~free] @ fixed
        rows, wishes = rows[:, free] * self._noise[free], wishes[:, free] * self._noise[free]
        state = at.ravel().copy()
        motion = solve_balanced_motion(rows, bounds, owners, wishes, wished, SOFTNESS, self._effort)
        state[free] = self._noise[free] * motion
        return state.reshape(-1, 6)

    def _apart_and_on_table(self, at: State, planes: Planes) -> Constraints:
        """Make the constraints of the planes, grouped by pairs of parts, and that no part sinks into the table."""
        blocks: list[tuple[Bounds, Rows, int]] = []
        for i, j, plane in planes:
            near = plane.spares_m <= REACH_M
            blocks.append((plane.spares_m[near], self._moves(at, i, j, plane, near), i * len(at) + j))
        blocks += [(*self._heights(at, i, points), i * len(at) + i) for i, points in self._lowest.items()]
        return _linearize(at, blocks)

    def _moves(self, at: State, i: int, j: int, plane: SeparatingPlane, which: Bool[np.ndarray, " k"]) -> Rows:
        """Derivatives of the separation at corners of a plane by the motions of both bodies."""
        points = plane.points[which]
        rows = np.zeros((len(points), at.size))
        turn = cross_matrix(plane.direction)
        for k, sign in ((i, 1.0), (j, -1.0)):
            arm = points - (self._pivots[k] + at[k, :3])
            rows[:, 6 * k : 6 * k + 3] = sign * plane.direction
            rows[:, 6 * k + 3 : 6 * k + 6] = sign * arm @ turn
        return rows

    def _heights(self, at: State, i: int, points: Float64[np.ndarray, "k 3"]) -> tuple[Bounds, Rows]:
        """Heights of points of a part above the table, and their derivatives."""
        rotation = rotation_matrix(quaternion_from_rotation_vector(at[i, 3:]))
        arm = (points - self._pivots[i]) @ rotation.T
        rows = np.zeros((len(points), at.size))
        rows[:, 6 * i + 2] = 1.0
        rows[:, 6 * i + 3], rows[:, 6 * i + 4] = arm[:, 1], -arm[:, 0]
        return arm[:, 2] + self._pivots[i, 2] + at[i, 2], rows

    def _trusted(self, at: State) -> Constraints:
        rows = np.concatenate([np.eye(at.size), -np.eye(at.size)])
        return rows, rows @ at.ravel() - np.tile(MAX_STEP, 2 * len(at)), np.full(len(rows), -1, dtype=np.int64)

    def _wishes(self, at: State, planes: Planes) -> tuple[Rows, Bounds]:
        """Make the wishes that carried parts touch their carriers."""
        blocks: list[tuple[Bounds, Rows, int]] = []
        best: dict[tuple[int, int], SeparatingPlane] = {}
        for i, j, plane in planes:
            if plane.direction[2] * self._support.rise(i, j) > UPWARD:
                best[(i, j)] = min(best.get((i, j), plane), plane, key=lambda found: found.spare_m)
        for (i, j), plane in best.items():
            first = plane.spares_m == plane.spares_m.min()
            blocks.append((np.array([plane.spare_m]), self._moves(at, i, j, plane, first)[:1], -1))
        for i, points in self._lowest.items():
            if self._parts[i].lowest_now_m < ON_TABLE_M:
                heights, rows = self._heights(at, i, points)
                least = [int(np.argmin(heights))]
                blocks.append((heights[least], rows[least], -1))
        rows, wished, _ = _linearize(at, blocks)
        return rows / CONTACT_M, wished / CONTACT_M


def _linearize(at: State, blocks: Sequence[tuple[Bounds, Rows, int]]) -> Constraints:
    """Make the constraints that values stay positive, of their current ones, their derivatives and their owners."""
    rows, bounds, owners = [np.zeros((0, at.size))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for values, block, owner in blocks:
        rows.append(block)
        bounds.append(block @ at.ravel() - values)
        owners.append(np.full(len(block), owner))
    return np.concatenate(rows), np.concatenate(bounds), np.concatenate(owners)


def _find_lowest_points(part: RigidPart) -> Float64[np.ndarray, "k 3"]:
    """Find the lowest points in directions around straight down, for small rotations of the part."""
    points = np.concatenate([part.vertices, part.body.solids.points]) + part.body.offset
    azimuth = np.arange(12) * np.pi / 6
    around = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(12)])
    down = np.array([0.0, 0.0, -1.0])
    directions = np.concatenate([[down], *(down + tilt * around for tilt in TILTS)])
    wide = float(np.linalg.norm(np.ptp(points[:, :2], axis=0)))
    points = points[points[:, 2] <= points[:, 2].min() + TILTS[-1] * wide]  # the others are lower in no direction
    return points[np.unique(np.argmax(points @ directions.T, axis=0))]
