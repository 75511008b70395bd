"""Least motion of a whole layout that frees it of collisions: a sequence of least-distance problems."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tableverse_factory.core.errors import SolverError
from tableverse_factory.geometry.collision.ldp_solver import SolverEffort, WorkLimitError, solve_balanced_motion
from tableverse_factory.geometry.collision.linear_sweep import MIN_MARGIN_M
from tableverse_factory.geometry.collision.separating_planes import PlaneFinder, PosedPieces, SeparatingPlane
from tableverse_factory.geometry.math.transforms import cross_matrix, quaternion_from_rotation_vector, rotation_matrix
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import ON_TABLE_M, SupportRelation
from tableverse_factory.stages.rectify.untangle import release_parts

State = Float64[np.ndarray, "n 6"]
"""Of each part, its translation [m] and its rotation vector about its centre of mass [rad]."""
Rows = Float64[np.ndarray, "m k"]
Bounds = Float64[np.ndarray, " m"]
Constraints = tuple[Rows, Bounds, Int64[np.ndarray, " m"]]
"""`rows @ state >= bounds`, and which of them belong together."""

NOISE = np.array([0.007, 0.007, 0.003, np.radians(1.0), np.radians(1.0), np.radians(4.0)])
"""Motions of these sizes weigh the same: about the noise of registration [m, rad]."""
MAX_STEP = np.array([0.006] * 3 + [np.radians(2.0)] * 3)
"""Trust region: the furthest that a part moves in one step along or about each axis [m, rad]."""
REACH_M = 0.012
"""Pairs of pieces with more room than this between them are left out of a step [m].

Two parts that both move as far as a step allows may close 21 mm and more and so collide; the next step separates them,
and after the last one the exact clean-up does.
"""
WISHED_REACH_M = 0.025  # the same for a part and its carrier, which noise may have moved this far apart [m]
STEPS, LAST_STEPS = 10, 5
MAX_WORK = 3e9
"""Budget of all steps of a layout, in constraints times the square of unknowns: thirty times that of ten objects in one
place."""
MAX_ENTRIES = 2e7  # corners near planes times unknowns of a step, at most: 160 MB; ten boxes in one place have 2e4
MAX_WAYS_OUT = 5000
"""Budget of ways out for a layout, in entangled pairs times parts: some seconds; a dozen objects have at most 800."""
CONVERGED = 2e-5
PATIENCE, STUCK_M = 4, 2e-4  # pairs that still overlap this much after this many steps are entangled [m]
EXTRA_M = 2e-6  # added to the clearance, so that the exact clean-up has nothing to do [m]
CONTACT_M = 0.0005  # deviation of a wished contact that costs as much as a motion by the noise [m]
SOFTNESS = 0.05
"""Remaining overlap, in `UNIT`, that costs as much as a motion by the noise, where the constraints contradict."""
TILTS = (0.05, 0.15)  # the lowest points are searched in directions this far from straight down [rad]
UPWARD = 0.3  # least vertical part of the normal of a wished contact
UNIT = 1e-3  # unit of the constraints, so that all numbers are near one [m]


@dataclass(frozen=True, slots=True, eq=False)
class SolverBudget:
    """Remaining budget of all clusters of a layout: for least-distance problems, and for ways out of entanglements."""

    motions: SolverEffort = field(default_factory=lambda: SolverEffort(MAX_WORK))
    ways: SolverEffort = field(default_factory=lambda: SolverEffort(MAX_WAYS_OUT))


class Relaxation:
    """Sequence of steps from the seen layout to the nearest collision-free one.

    Each step minimises the motion from the seen layout, weighted by the noise, and the gaps of wished contacts, such
    that every pair of pieces stays separated, no part is below the table, and each stays in its trust region.
    """

    def __init__(
        self, parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float, allowance: SolverBudget
    ) -> None:
        self._parts, self._support = parts, support
        self._clearance = clearance_m + EXTRA_M
        self._separator = PlaneFinder()
        self._allowance = allowance
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
                after, unsolved = self._tried(at, planes, free)
                violation = max((-plane.spare_m for _, _, plane in planes), default=0.0)
                done = violation <= CONVERGED and np.abs(after - at).max() <= CONVERGED
                at = after
                if done:
                    break
        if unsolved is not None:
            raise unsolved
        return self._placed(at)

    def _tried(
        self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]], free: Bool[np.ndarray, " n"]
    ) -> tuple[State, SolverError | None]:
        """Try a step; where it has no solution, return the same state and the error."""
        corners = sum(len(plane.points) for _, _, plane in planes)
        if corners * at.size > MAX_ENTRIES:
            raise WorkLimitError(f"{corners} corners of {len(at)} parts are near planes")
        try:
            return self._step(at, planes, free), None
        except WorkLimitError:
            raise
        except SolverError as error:
            return at, error

    def _placed(self, at: State) -> list[RigidPart]:
        return [part.turned(state[3:]).moved(state[:3]) for part, state in zip(self._parts, at, strict=True)]

    def _untangled(
        self, at: State, planes: list[tuple[int, int, SeparatingPlane]]
    ) -> tuple[State, list[tuple[int, int, SeparatingPlane]]]:
        """Move entangled parts the shortest way out; returns the state and its planes.

        Raises:
            WorkLimitError: if too much is entangled.
        """
        stuck = sorted({(i, j) for i, j, plane in planes if plane.spare_m < -STUCK_M})
        if not stuck:
            return at, planes
        self._allowance.ways.spend(len(stuck) * len(at), f"{len(stuck)} entangled pairs of {len(at)} parts")
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

    def _planes(self, at: State) -> list[tuple[int, int, SeparatingPlane]]:
        stances = [self._stance(i, state) for i, state in enumerate(at)]
        found: list[tuple[int, int, SeparatingPlane]] = []
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

    def _step(
        self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]], free: Bool[np.ndarray, " n"]
    ) -> State:
        """Find the state nearest to the seen layout that all linearised planes allow."""
        blocks = [self._apart(at, planes), self._on_table(at), self._trusted(at)]
        rows = np.concatenate([rows for rows, _, _ in blocks]) / UNIT
        bounds = np.concatenate([bounds for _, bounds, _ in blocks]) / UNIT
        owners = np.concatenate([owners for _, _, owners in blocks])
        wishes, wished = self._wishes(at, planes)
        fixed = at.ravel()[~free]
        bounds, wished = bounds - rows[:, ~free] @ fixed, wished - wishes[:, ~free] @ fixed
        rows, wishes = rows[:, free] * self._noise[free], wishes[:, free] * self._noise[free]
        state = at.ravel().copy()
        motion = solve_balanced_motion(rows, bounds, owners, wishes, wished, SOFTNESS, self._allowance.motions)
        state[free] = self._noise[free] * motion
        return state.reshape(-1, 6)

    def _apart(self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]]) -> Constraints:
        """Make the constraints of the planes, grouped by pairs of parts."""
        rows, bounds, owners = [np.zeros((0, at.size))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
        for i, j, plane in planes:
            near = plane.spares_m <= REACH_M
            block = self._moves(at, i, j, plane, near)
            rows.append(block)
            bounds.append(block @ at.ravel() - plane.spares_m[near])
            owners.append(np.full(len(block), i * len(at) + j))
        return np.concatenate(rows), np.concatenate(bounds), np.concatenate(owners)

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

    def _on_table(self, at: State) -> Constraints:
        """Make the constraints that no part sinks into the table."""
        rows, bounds, owners = [np.zeros((0, at.size))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
        for i, points in self._lowest.items():
            heights, block = self._heights(at, i, points)
            rows.append(block)
            bounds.append(block @ at.ravel() - heights)
            owners.append(np.full(len(block), i * len(at) + i))
        return np.concatenate(rows), np.concatenate(bounds), np.concatenate(owners)

    def _heights(self, at: State, i: int, points: Float64[np.ndarray, "k 3"]) -> tuple[Bounds, Rows]:
        """Heights of points of a part above the table, and their derivatives."""
        rotation = rotation_matrix(quaternion_from_rotation_vector(at[i, 3:]))
        arm = (points - self._pivots[i]) @ rotation.T
        rows = np.zeros((len(points), at.size))
        rows[:, 6 * i + 2] = 1.0
        rows[:, 6 * i + 3], rows[:, 6 * i + 4] = arm[:, 1], -arm[:, 0]
        return arm[:, 2] + self._pivots[i, 2] + at[i, 2], rows

    def _trusted(self, at: State) -> Constraints:
        """Make the constraints of the trust region."""
        rows = np.concatenate([np.eye(at.size), -np.eye(at.size)])
        return rows, rows @ at.ravel() - np.tile(MAX_STEP, 2 * len(at)), np.full(len(rows), -1, dtype=np.int64)

    def _wishes(self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]]) -> tuple[Rows, Bounds]:
        """Make the wishes that carried parts touch their carriers."""
        rows, wished = [np.zeros((0, at.size))], [np.zeros(0)]
        best: dict[tuple[int, int], SeparatingPlane] = {}
        for i, j, plane in planes:
            if plane.direction[2] * self._support.rise(i, j) > UPWARD:
                known = best.get((i, j))
                if known is None or plane.spare_m < known.spare_m:
                    best[(i, j)] = plane
        for (i, j), plane in best.items():
            first = plane.spares_m == plane.spares_m.min()
            block = self._moves(at, i, j, plane, first)[:1]
            rows.append(block / CONTACT_M)
            wished.append((block @ at.ravel() - plane.spare_m) / CONTACT_M)
        for i, points in self._lowest.items():
            if self._parts[i].lowest_now_m < ON_TABLE_M:
                heights, block = self._heights(at, i, points)
                least = [int(np.argmin(heights))]
                rows.append(block[least] / CONTACT_M)
                wished.append((block[least] @ at.ravel() - heights[least]) / CONTACT_M)
        return np.concatenate(rows), np.concatenate(wished)


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
