"""The least motion of a whole layout that makes it free: a sequence of least-distance problems."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tableverse_factory.core.errors import SolverError
from tableverse_factory.geometry.collision.ldp_solver import SolverEffort, TooMuchWorkError, balanced_motion
from tableverse_factory.geometry.collision.ray_clearance import LEAST_MARGIN_M
from tableverse_factory.geometry.collision.separating_planes import SeparatingPlane, Separator, Stance, cross_matrix
from tableverse_factory.geometry.math.transforms import quaternion_from_rotation_vector, rotation_matrix
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import ON_TABLE_M, SupportRelation
from tableverse_factory.stages.rectify.untangle import released

State = Float64[np.ndarray, "n 6"]
"""Of each part, its translation [m] and its rotation vector about its centre of mass [rad]."""
Rows = Float64[np.ndarray, "m k"]
Bounds = Float64[np.ndarray, " m"]
Constraints = tuple[Rows, Bounds, Int64[np.ndarray, " m"]]
"""`rows @ state >= bounds`, and which of them belong together."""

NOISE = np.array([0.007, 0.007, 0.003, np.radians(1.0), np.radians(1.0), np.radians(4.0)])
"""Motions of these sizes weigh the same: about the noise of registration [m, rad]."""
TRUST = np.array([0.006] * 3 + [np.radians(2.0)] * 3)
"""The furthest that a part goes in one step along or about each axis [m, rad]."""
REACH_M = 0.012
"""Pairs of pieces with more room than this between them are left out of a step [m].

Two parts that both go as far as a step trusts them may close 21 mm and more and so meet unseen; the next step parts
them, and after the last one the exact clean-up does.
"""
WISHED_REACH_M = 0.025
"""The same of what is carried and what carries it: noise may have taken them this far from one another [m]."""
STEPS, LAST_STEPS = 10, 5
MOST_WORK = 3e9
"""What all steps of all clusters of a layout together may cost, in constraints times the square of unknowns: thirty
times what ten things in one place do."""
MOST_ENTRIES = 2e7
"""Corners near planes times unknowns beyond which no step is tried: 160 MB; ten boxes in one place have 2e4."""
MOST_WAYS = 5000
"""How many ways out all clusters of a layout together may seek, in entangled pairs times parts: some seconds; a dozen
things have at most 800."""
CONVERGED = 2e-5
PATIENCE, STUCK_M = 4, 2e-4
"""What still overlaps this much after so many steps is entangled [m]."""
EXTRA_M = 2e-6
"""Kept on top of the clearance, so that the exact clean-up finds nothing to do [m]."""
CONTACT_M = 0.0005
"""How far a wished contact may stay open or closed at the price of a motion by the noise [m]."""
SOFTNESS = 0.05
"""How far overlapping things may stay so, in `UNIT`, at the price of a motion by the noise, where all else fails."""
TILTS = (0.05, 0.15)
"""The lowest points are looked for in directions this far from straight down [rad]."""
UPWARD = 0.3
"""Least vertical part of the normal of a contact that is wished for."""
UNIT = 1e-3
"""Constraints are counted in this, so that all figures are near one [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SolverBudget:
    """What the clusters of a layout together may still cost, those included that are solved again because they met.

    Attributes:
        motions: The least-distance problems.
        ways: The ways out of entanglements.
    """

    motions: SolverEffort = field(default_factory=lambda: SolverEffort(MOST_WORK))
    ways: SolverEffort = field(default_factory=lambda: SolverEffort(MOST_WAYS))


class Relaxation:
    """A layout on its way from where it was seen to the nearest state in which it is free.

    Each step solves: least motion from where it was seen, weighed by the noise, and wished contacts closed, such that
    every pair of pieces stays on its sides of its plane, nothing is below the table, and no part goes too far at once.
    """

    def __init__(
        self, parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float, allowance: SolverBudget
    ) -> None:
        self._parts, self._support = parts, support
        self._clearance = clearance_m + EXTRA_M
        self._separator = Separator()
        self._allowance = allowance
        self._noise = np.tile(NOISE, len(parts))
        self._pivots = np.array([part.mass_center_now for part in parts])
        self._lowest = {i: _lowest_points(part) for i, part in enumerate(parts) if not support.standing[i]}

    def result(self) -> list[RigidPart]:
        """Where the layout ends; free of overlaps unless the steps ran out.

        The last steps only translate: then pairs that have a plane are apart, not only to first order. A step without
        an answer leaves the layout where it is: what is entangled may be released before the next.

        Raises:
            SolverError: if it is too much work, too much is entangled, or the last step had no answer.
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
        """The state after a step; the same one, and why, where the step has no answer."""
        corners = sum(len(plane.points) for _, _, plane in planes)
        if corners * at.size > MOST_ENTRIES:
            raise TooMuchWorkError(f"{corners} corners of {len(at)} parts are near planes")
        try:
            return self._step(at, planes, free), None
        except TooMuchWorkError:
            raise
        except SolverError as error:
            return at, error

    def _placed(self, at: State) -> list[RigidPart]:
        return [part.turned(state[3:]).moved(state[:3]) for part, state in zip(self._parts, at, strict=True)]

    def _untangled(
        self, at: State, planes: list[tuple[int, int, SeparatingPlane]]
    ) -> tuple[State, list[tuple[int, int, SeparatingPlane]]]:
        """The state after what is entangled went the shortest way out, and its planes.

        Raises:
            TooMuchWorkError: if too much of it is.
        """
        stuck = sorted({(i, j) for i, j, plane in planes if plane.spare_m < -STUCK_M})
        if not stuck:
            return at, planes
        self._allowance.ways.spend(len(stuck) * len(at), f"{len(stuck)} entangled pairs of {len(at)} parts")
        before = self._placed(at)
        after = released(before, self._support, stuck, self._clearance)
        free = at.copy()
        free[:, :3] += [new.body.offset - old.body.offset for new, old in zip(after, before, strict=True)]
        return free, self._planes(free)

    def _free_axes(self, turning: bool) -> Bool[np.ndarray, " n"]:
        """What stands on the table keeps its height and its tilt."""
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
            margin = max(self._clearance + spare, LEAST_MARGIN_M)
            pair, rise = (stances[i], stances[j]), self._support.rise(i, j)
            planes = list(self._separator.planes(*pair, margin, REACH_M, rise))
            if rise and not planes:
                planes = list(self._separator.planes(*pair, margin, WISHED_REACH_M, rise))
            found.extend((i, j, plane) for plane in planes)
        return found

    def _stance(self, i: int, state: Float64[np.ndarray, "6"]) -> Stance:
        rotation = rotation_matrix(quaternion_from_rotation_vector(state[3:]))
        body, pivot = self._parts[i].body, self._pivots[i]
        return Stance(body.solids, rotation, rotation @ (body.offset - pivot) + pivot + state[:3])

    def _step(
        self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]], free: Bool[np.ndarray, " n"]
    ) -> State:
        """The state nearest to where the layout was seen that all planes allow, as far as they are linear."""
        blocks = [self._apart(at, planes), self._on_table(at), self._trusted(at)]
        rows = np.concatenate([rows for rows, _, _ in blocks]) / UNIT
        bounds = np.concatenate([bounds for _, bounds, _ in blocks]) / UNIT
        owners = np.concatenate([owners for _, _, owners in blocks])
        wishes, wished = self._wishes(at, planes)
        fixed = at.ravel()[~free]
        bounds, wished = bounds - rows[:, ~free] @ fixed, wished - wishes[:, ~free] @ fixed
        rows, wishes = rows[:, free] * self._noise[free], wishes[:, free] * self._noise[free]
        state = at.ravel().copy()
        motion = balanced_motion(rows, bounds, owners, wishes, wished, SOFTNESS, self._allowance.motions)
        state[free] = self._noise[free] * motion
        return state.reshape(-1, 6)

    def _apart(self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]]) -> Constraints:
        """What the planes demand; those of one pair of parts belong together."""
        rows, bounds, owners = [np.zeros((0, at.size))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
        for i, j, plane in planes:
            near = plane.spares_m <= REACH_M
            block = self._moves(at, i, j, plane, near)
            rows.append(block)
            bounds.append(block @ at.ravel() - plane.spares_m[near])
            owners.append(np.full(len(block), i * len(at) + j))
        return np.concatenate(rows), np.concatenate(bounds), np.concatenate(owners)

    def _moves(self, at: State, i: int, j: int, plane: SeparatingPlane, which: Bool[np.ndarray, " k"]) -> Rows:
        """How fast the corners of a plane part as either body moves and turns."""
        points = plane.points[which]
        rows = np.zeros((len(points), at.size))
        turn = cross_matrix(plane.direction)
        for k, sign in ((i, 1.0), (j, -1.0)):
            arm = points - (self._pivots[k] + at[k, :3])
            rows[:, 6 * k : 6 * k + 3] = sign * plane.direction
            rows[:, 6 * k + 3 : 6 * k + 6] = sign * arm @ turn
        return rows

    def _on_table(self, at: State) -> Constraints:
        """No part sinks into the table."""
        rows, bounds, owners = [np.zeros((0, at.size))], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
        for i, points in self._lowest.items():
            heights, block = self._heights(at, i, points)
            rows.append(block)
            bounds.append(block @ at.ravel() - heights)
            owners.append(np.full(len(block), i * len(at) + i))
        return np.concatenate(rows), np.concatenate(bounds), np.concatenate(owners)

    def _heights(self, at: State, i: int, points: Float64[np.ndarray, "k 3"]) -> tuple[Bounds, Rows]:
        """Heights of points of a part above the table, and how fast they rise as it moves and turns."""
        rotation = rotation_matrix(quaternion_from_rotation_vector(at[i, 3:]))
        arm = (points - self._pivots[i]) @ rotation.T
        rows = np.zeros((len(points), at.size))
        rows[:, 6 * i + 2] = 1.0
        rows[:, 6 * i + 3], rows[:, 6 * i + 4] = arm[:, 1], -arm[:, 0]
        return arm[:, 2] + self._pivots[i, 2] + at[i, 2], rows

    def _trusted(self, at: State) -> Constraints:
        """How far a step may go."""
        rows = np.concatenate([np.eye(at.size), -np.eye(at.size)])
        return rows, rows @ at.ravel() - np.tile(TRUST, 2 * len(at)), np.full(len(rows), -1, dtype=np.int64)

    def _wishes(self, at: State, planes: Sequence[tuple[int, int, SeparatingPlane]]) -> tuple[Rows, Bounds]:
        """Contacts that the support speaks of: what is carried should touch what carries it."""
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


def _lowest_points(part: RigidPart) -> Float64[np.ndarray, "k 3"]:
    """The lowest points in directions around straight down: one of them stays the lowest as the part turns a little."""
    points = np.concatenate([part.vertices, part.body.solids.points]) + part.body.offset
    azimuth = np.arange(12) * np.pi / 6
    around = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(12)])
    down = np.array([0.0, 0.0, -1.0])
    directions = np.concatenate([[down], *(down + tilt * around for tilt in TILTS)])
    wide = float(np.linalg.norm(np.ptp(points[:, :2], axis=0)))
    points = points[points[:, 2] <= points[:, 2].min() + TILTS[-1] * wide]  # the others are lower in no direction
    lowest: Float64[np.ndarray, "k 3"] = points[np.unique(np.argmax(points @ directions.T, axis=0))]
    return lowest
