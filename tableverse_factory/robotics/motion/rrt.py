"""Collision-free joint paths: RRT-Connect (Kuffner and LaValle 2000), then shortcuts.

Bounds are counts and never clocks, and all chance comes from the `rng` that is given: the same world and seed, the
same path.
"""

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.robotics.motion.world import Space, World

EDGE_STEP_RAD = 0.02
"""Largest motion of any joint between two checks while planning; the finished motion is looked at more finely."""
EXTENSION_RAD = 0.4
"""Longest branch of a tree, as the largest motion of any joint."""
MAX_BRANCHES = 1500
SHORTCUTS = 40


class _Tree:
    """Configurations, each with the one it was reached from; the first is the root."""

    def __init__(self, root: JointVector) -> None:
        self.parents = [0]
        self._points = np.empty((256, len(root)))
        self._points[0] = root

    def nearest(self, q: JointVector) -> int:
        return int(np.argmin(((self._points[: len(self.parents)] - q) ** 2).sum(axis=1)))

    def at(self, index: int) -> JointVector:
        point: JointVector = self._points[index]
        return point

    def add(self, q: JointVector, parent: int) -> int:
        if len(self.parents) == len(self._points):
            self._points = np.concatenate([self._points, np.empty_like(self._points)])
        self._points[len(self.parents)] = q
        self.parents.append(parent)
        return len(self.parents) - 1

    def to_root(self, index: int) -> list[JointVector]:
        row = [self.at(index)]
        while index:
            index = self.parents[index]
            row.append(self.at(index))
        return row


class RrtConnect:
    """The planner that runs anywhere."""

    def path(self, start: JointVector, goal: JointVector, space: Space, rng: np.random.Generator) -> JointPath | None:
        """Corners of a free path with both ends, or None where none was found within the bound.

        Args:
            start: Shape (j,) [rad].
            goal: Shape (j,) [rad].
            space: What counts as free.
            rng: The only source of chance.
        """
        if not space.free(start) or not space.free(goal):
            return None
        if space.free_edge(start, goal, EDGE_STEP_RAD):
            return np.array([start, goal])
        found = _connect(start, goal, space, rng)
        return None if found is None else shortened(found, space, rng)

    def fallbacks(self, world: World) -> tuple[str, ...]:  # noqa: ARG002
        """Nothing: it asks the scene's own collision check."""
        return ()


def _connect(start: JointVector, goal: JointVector, space: Space, rng: np.random.Generator) -> JointPath | None:
    chain = space.world.chain
    trees = (_Tree(start), _Tree(goal))
    growing = 0
    while sum(len(tree.parents) for tree in trees) < MAX_BRANCHES and growing < 4 * MAX_BRANCHES:
        tree, other = trees[growing % 2], trees[1 - growing % 2]
        tip = _extend(tree, rng.uniform(chain.lower, chain.upper), space)
        if tip is not None:
            met = _reach(other, tree.at(tip), space)
            if met is not None:
                rows = (tree.to_root(tip)[::-1], other.to_root(met)[1:])
                row = rows[0] + rows[1] if growing % 2 == 0 else rows[1][::-1] + rows[0][::-1]
                return np.array(row)
        growing += 1
    return None


def _extend(tree: _Tree, towards: JointVector, space: Space) -> int | None:
    """A new branch of bounded length towards a configuration; None where it is blocked."""
    near = tree.nearest(towards)
    start = tree.at(near).copy()
    share = EXTENSION_RAD / max(float(np.abs(towards - start).max()), EXTENSION_RAD)
    goal = start + share * (towards - start)
    if not space.free(goal) or not space.free_edge(start, goal, EDGE_STEP_RAD):
        return None
    return tree.add(goal, near)


def _reach(tree: _Tree, goal: JointVector, space: Space) -> int | None:
    """Branches towards a configuration until it is reached; None where something is in the way."""
    while True:
        tip = _extend(tree, goal, space)
        if tip is None:
            return None
        if np.array_equal(tree.at(tip), goal):
            return tip


def shortened(path: JointPath, space: Space, rng: np.random.Generator) -> JointPath:
    """The same ends with fewer and nearer corners: straight lines between random points of the path, where free."""
    corners = _without_detours(path, space)
    for _ in range(SHORTCUTS):
        if len(corners) < 3:
            break
        lengths = np.abs(np.diff(corners, axis=0)).max(axis=1)
        marks = np.concatenate([[0.0], np.cumsum(lengths)])
        low, high = np.sort(rng.uniform(0.0, marks[-1], 2))
        first, last = np.searchsorted(marks, (low, high), side="right") - 1
        if first == last:
            continue
        ends = [_at(corners, marks, value) for value in (low, high)]
        direct = float(np.abs(ends[1] - ends[0]).max())
        if direct < 0.999 * (high - low) and space.free_edge(ends[0], ends[1], EDGE_STEP_RAD):
            corners = np.array([*corners[: first + 1], *ends, *corners[last + 1 :]])
    return _without_detours(corners, space)


def _without_detours(path: JointPath, space: Space) -> JointPath:
    """From each corner straight to the farthest one that can be seen from it."""
    kept, at = [path[0]], 0
    while at < len(path) - 1:
        ahead = next(k for k in range(len(path) - 1, at, -1) if k == at + 1 or _sees(path[at], path[k], space))
        kept.append(path[ahead])
        at = ahead
    return np.array(kept)


def _sees(start: JointVector, goal: JointVector, space: Space) -> bool:
    return space.free_edge(start, goal, EDGE_STEP_RAD)


def _at(corners: JointPath, marks: np.ndarray, value: float) -> JointVector:
    index = min(int(np.searchsorted(marks, value, side="right")) - 1, len(corners) - 2)
    share = (value - marks[index]) / max(marks[index + 1] - marks[index], 1e-12)
    point: JointVector = corners[index] + share * (corners[index + 1] - corners[index])
    return point
