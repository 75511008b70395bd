"""Collision-free joint paths by RRT-Connect (Kuffner and LaValle 2000) and shortcutting.

Bounds are counts, not clocks, and `rng` is the only source of randomness: same world and seed, same path.
"""

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld

# Largest motion of any joint between two checks while planning; the finished motion is checked more finely
EDGE_STEP_RAD = 0.02
EXTENSION_RAD = 0.4  # longest branch of a tree, as the largest motion of any joint
MAX_BRANCHES = 1500
SHORTCUTS = 40


class _Tree:
    """Configurations with their parents; the first is the root."""

    def __init__(self, root: JointVector) -> None:
        self.parents = [0]
        self._points = np.empty((256, len(root)))
        self._points[0] = root

    def nearest(self, q: JointVector) -> int:
        return int(np.argmin(((self._points[: len(self.parents)] - q) ** 2).sum(axis=1)))

    def at(self, index: int) -> JointVector:
        return self._points[index]

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
    """CPU planner without dependencies."""

    def plan_path(
        self, start: JointVector, goal: JointVector, space: CollisionSpace, rng: np.random.Generator
    ) -> JointPath | None:
        """Plan corners of a free path, both ends included, or return None within the bound."""
        if not space.is_free(start) or not space.is_free(goal):
            return None
        if space.is_edge_free(start, goal, EDGE_STEP_RAD):
            return np.array([start, goal])
        found = _connect_trees(start, goal, space, rng)
        return None if found is None else shorten_path(found, space, rng)

    def list_fallbacks(self, _world: CollisionWorld) -> tuple[str, ...]:
        """Return none: collisions are checked on the scene itself."""
        return ()


def _connect_trees(
    start: JointVector, goal: JointVector, space: CollisionSpace, rng: np.random.Generator
) -> JointPath | None:
    chain = space.world.chain
    trees = (_Tree(start), _Tree(goal))
    growing = 0
    while sum(len(tree.parents) for tree in trees) < MAX_BRANCHES and growing < 4 * MAX_BRANCHES:
        tree, other = trees[growing % 2], trees[1 - growing % 2]
        tip = _extend_tree(tree, rng.uniform(chain.lower, chain.upper), space)
        if tip is not None and (met := _grow_to(other, tree.at(tip), space)) is not None:
            row = tree.to_root(tip)[::-1] + other.to_root(met)[1:]
            return np.array(row if growing % 2 == 0 else row[::-1])
        growing += 1
    return None


def _extend_tree(tree: _Tree, towards: JointVector, space: CollisionSpace) -> int | None:
    """Grow a branch of bounded length towards a configuration; None where it is blocked."""
    near = tree.nearest(towards)
    start = tree.at(near).copy()
    share = EXTENSION_RAD / max(float(np.abs(towards - start).max()), EXTENSION_RAD)
    goal = start + share * (towards - start)
    if not space.is_free(goal) or not space.is_edge_free(start, goal, EDGE_STEP_RAD):
        return None
    return tree.add(goal, near)


def _grow_to(tree: _Tree, goal: JointVector, space: CollisionSpace) -> int | None:
    """Grow branches until a configuration is reached; None where an obstacle is in the way."""
    while True:
        tip = _extend_tree(tree, goal, space)
        if tip is None or np.array_equal(tree.at(tip), goal):
            return tip


def shorten_path(path: JointPath, space: CollisionSpace, rng: np.random.Generator) -> JointPath:
    """Shortcut a path by free straight lines between random points of it."""
    corners = _skip_corners(path, space)
    for _ in range(SHORTCUTS):
        if len(corners) < 3:
            break
        lengths = np.abs(np.diff(corners, axis=0)).max(axis=1)
        marks = np.concatenate([[0.0], np.cumsum(lengths)])
        low, high = np.sort(rng.uniform(0.0, marks[-1], 2))
        first, last = np.searchsorted(marks, (low, high), side="right") - 1
        if first == last:
            continue
        ends = [_interpolate_path(corners, marks, value) for value in (low, high)]
        direct = float(np.abs(ends[1] - ends[0]).max())
        if direct < 0.999 * (high - low) and space.is_edge_free(ends[0], ends[1], EDGE_STEP_RAD):
            corners = np.array([*corners[: first + 1], *ends, *corners[last + 1 :]])
    return _skip_corners(corners, space)


def _skip_corners(path: JointPath, space: CollisionSpace) -> JointPath:
    """Connect each corner to the farthest one in free straight view."""
    kept, at = [path[0]], 0
    while at < len(path) - 1:
        farthest_first = range(len(path) - 1, at, -1)
        ahead = next(k for k in farthest_first if k == at + 1 or space.is_edge_free(path[at], path[k], EDGE_STEP_RAD))
        kept.append(path[ahead])
        at = ahead
    return np.array(kept)


def _interpolate_path(corners: JointPath, marks: np.ndarray, value: float) -> JointVector:
    index = min(int(np.searchsorted(marks, value, side="right")) - 1, len(corners) - 2)
    share = (value - marks[index]) / max(marks[index + 1] - marks[index], 1e-12)
    return corners[index] + share * (corners[index + 1] - corners[index])
