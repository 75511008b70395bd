"""Paths end where they should, are free by other eyes, the same each time, and end in None within the bound."""

from itertools import pairwise

import numpy as np
import pytest

from tableverse_factory.robotics.motion.kinematics import solve_ik
from tableverse_factory.robotics.motion.rrt import EDGE_STEP_RAD, RrtConnect, shorten_path
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld
from tests.helpers.simple_scenes import Solid, box
from tests.helpers.work_cells import BLOCK, HOME, clutter, deepest, down, object_geoms, station_of

MARGIN_M = 0.005


def dense(path: np.ndarray, step: float = 0.01) -> np.ndarray:
    rows = [path[:1]]
    for a, b in pairwise(path):
        count = max(int(np.ceil(np.abs(b - a).max() / step)), 1)
        rows.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(rows)


def at(world: CollisionWorld, x: float, y: float, z: float) -> np.ndarray:
    space = CollisionSpace(world, 0.04, margin_m=MARGIN_M)
    turns = [solve_ik(world.chain, world.in_base(down(x, y, z, yaw)), HOME, 6) for yaw in (0.0, 0.8, 1.6, 2.4)]
    return next(q for q in np.concatenate(turns) if space.is_free(q))


@pytest.mark.parametrize(
    ("start", "goal"), [((-0.05, -0.12, 0.08), (0.1, 0.16, 0.08)), ((0.2, 0.05, 0.05), (-0.25, 0.0, 0.12))]
)
def test_a_path_is_free_by_the_distance_of_every_pair_and_the_same_each_time(start, goal):
    world = clutter()
    space = CollisionSpace(world, 0.04, margin_m=MARGIN_M)
    ends = [at(world, *start), at(world, *goal)]
    path = RrtConnect().plan_path(*ends, space, np.random.default_rng(0))
    np.testing.assert_array_equal(path[[0, -1]], ends)
    for q in dense(path, 0.05):
        assert deepest(world, q, 0.04, None, object_geoms(world)) > 0.0
        assert (q >= world.chain.lower).all()
        assert (q <= world.chain.upper).all()
    np.testing.assert_array_equal(path, RrtConnect().plan_path(*ends, space, np.random.default_rng(0)))


def walled(gap_m: float) -> CollisionWorld:
    """A wall across the table with one opening, and a lid over it: the gripper has to go through."""
    side = (0.6 - gap_m) / 2
    walls = [
        Solid(box(side, 0.04, 0.4), (s * (gap_m + side) / 2, 0.1, 0.2), object_id=f"wall_{s + 1}") for s in (-1, 1)
    ]
    return CollisionWorld(station_of([*walls, Solid(box(0.6, 0.04, 0.1), (0.0, 0.1, 0.75), object_id="lid")]))


def test_a_narrow_passage_is_found():
    world = walled(0.3)
    space = CollisionSpace(world, 0.04, margin_m=MARGIN_M)
    ends = [at(world, -0.2, -0.05, 0.15), at(world, 0.0, 0.2, 0.12)]
    assert not space.is_edge_free(*ends, EDGE_STEP_RAD)
    path = RrtConnect().plan_path(*ends, space, np.random.default_rng(0))
    assert path is not None
    assert space.find_first_collision(dense(path)) is None
    y = [world.tcp(q).position[1] for q in dense(path)]
    assert min(y) < 0.08 < 0.12 < max(y)


def test_what_is_blocked_gives_none_within_the_bound():
    world = clutter()
    space = CollisionSpace(world, 0.04, margin_m=MARGIN_M)
    inside = solve_ik(world.chain, world.in_base(down(0.0, 0.0, 0.05)), HOME, 1)[0]
    assert not space.is_free(inside)
    assert RrtConnect().plan_path(HOME, inside, space, np.random.default_rng(0)) is None
    assert RrtConnect().plan_path(inside, HOME, space, np.random.default_rng(0)) is None


@pytest.mark.slow
def test_a_goal_without_a_way_to_it_ends_too():
    boxed_in = [Solid(box(0.02, 0.3, 0.3), (s * 0.13, 0.0, 0.15), object_id=f"x_{s + 1}") for s in (-1, 1)]
    boxed_in += [Solid(box(0.24, 0.02, 0.3), (0.0, s * 0.14, 0.15), object_id=f"y_{s + 1}") for s in (-1, 1)]
    world = CollisionWorld(station_of([*boxed_in, Solid(box(0.3, 0.3, 0.02), (0.0, 0.0, 0.8), object_id="lid")]))
    space = CollisionSpace(world, 0.04)
    free = [q for q in solve_ik(world.chain, world.in_base(down(0.0, 0.0, 0.2)), HOME, 6) if space.is_free(q)]
    for goal in free[:1]:
        path = RrtConnect().plan_path(HOME, goal, space, np.random.default_rng(0))
        assert path is None or space.find_first_collision(dense(path)) is None


def test_shortcuts_keep_the_ends_and_make_nothing_longer():
    world, rng = clutter(), np.random.default_rng(1)
    space = CollisionSpace(world, 0.04)
    detour = np.array([HOME, HOME + 0.2, HOME + np.array([0.3, -0.2, 0.1, 0.1, 0, 0, 0]), HOME - 0.1])
    short = shorten_path(detour, space, rng)
    np.testing.assert_array_equal(short[[0, -1]], detour[[0, -1]])
    assert np.abs(np.diff(short, axis=0)).sum() <= np.abs(np.diff(detour, axis=0)).sum() + 1e-9
    assert space.find_first_collision(dense(short)) is None
    assert BLOCK in world.station.object_ids
