"""Free is what MuJoCo's own distances say is free, in every phase."""

import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.robotics.motion.dynamics import CarriedObject
from tableverse_factory.robotics.motion.kinematics import solve_ik
from tableverse_factory.robotics.motion.pick_place import PickPlace
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld, _order_coarse_to_fine
from tests.helpers.simple_scenes import Solid, box
from tests.helpers.work_cells import (
    BLOCK,
    GRASP_M,
    HOME,
    WIDTH_M,
    alone,
    block,
    clutter,
    deepest,
    down,
    held_pose,
    object_geoms,
    station_of,
)


def near_the_table(count: int) -> np.ndarray:
    """Configurations in which the gripper is among the things."""
    world, rng, rows = clutter(), np.random.default_rng(3), []
    while len(rows) < count:
        x, y, z, yaw = rng.uniform([-0.2, -0.2, 0.0, -3.0], [0.25, 0.2, 0.3, 3.0])
        rows.extend(solve_ik(world.chain, world.in_base(down(x, y, z, yaw)), HOME, 1))
    return np.array(rows)


@pytest.mark.heavy
@pytest.mark.parametrize("carrying", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_free_agrees_with_the_distance_of_every_pair(carrying):
    world = clutter()
    held = held_pose(down(0.0, 0.0, GRASP_M), world.object_pose(BLOCK)) if carrying else None
    carried = CarriedObject(BLOCK, held) if held else None
    for margin in (0.0, 0.01):
        space, seen = CollisionSpace(world, 0.06, margin_m=margin, carried=carried), set()
        for q in near_the_table(60):
            distance = deepest(world, q, 0.06, held, object_geoms(world))
            if abs(distance - margin) < 2e-4:
                continue  # the two routines differ by that much
            free = space.is_free(q)
            if free and distance < margin:
                raise AssertionError(f"{distance} is nearer than {margin}: {world.describe_collision(space, q)}")
            if not free and distance > margin:  # the held object on the table, or the arm with itself
                assert (
                    "table" in world.describe_collision(space, q)
                    or world.describe_collision(space, q).count("robot") == 2
                )
            seen.add(free)
        assert seen == {True, False}


def test_a_block_standing_on_the_table_may_be_lifted_but_not_pushed_down():
    world = clutter()
    grasp = down(0.0, 0.0, GRASP_M)
    at, below, above = (
        solve_ik(world.chain, world.in_base(down(0.0, 0.0, GRASP_M + z)), HOME, 1)[0] for z in (0.0, -0.002, 0.003)
    )
    task = PickPlace(world, BLOCK, grasp, grasp, WIDTH_M)
    strict = task.holding_space(0.0003, task.taken)
    assert not strict.is_free(at)
    taking = task.allow_grasp_contacts(at)
    lift = taking.holding_space(0.0003, taking.taken)
    assert lift.is_free(at)
    assert lift.is_free(above)
    assert not lift.is_free(below)
    assert "table" in world.describe_collision(lift, below)


def test_open_fingers_may_not_touch_what_they_are_to_grasp():
    world = clutter()
    q = solve_ik(world.chain, world.in_base(down(0.0, 0.0, GRASP_M)), HOME, 1)[0]
    assert CollisionSpace(world, WIDTH_M + 0.01).is_free(q)
    assert not CollisionSpace(world, WIDTH_M - 0.01).is_free(q)


def test_an_object_that_was_let_go_elsewhere_is_an_obstacle_there_and_no_more_here():
    world = alone()
    here, there = (solve_ik(world.chain, world.in_base(down(x, 0.0, 0.04)), HOME, 1)[0] for x in (0.0, 0.2))
    standing = {BLOCK: Pose(np.array([0.2, 0.0, 0.05]), _UPRIGHT)}
    as_is, moved = CollisionSpace(world, 0.02), CollisionSpace(world, 0.02, standing=standing)
    assert (as_is.is_free(here), as_is.is_free(there)) == (False, True)
    assert (moved.is_free(here), moved.is_free(there)) == (True, False)


_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def test_the_arm_may_not_go_through_itself():
    folded = np.array([0.0, -1.7, 0.0, -3.05, 0.0, 0.1, 0.0])
    assert not CollisionSpace(alone(), 0.04).is_free(folded)
    assert alone().describe_collision(CollisionSpace(alone(), 0.04), folded).count("robot/") == 2
    assert CollisionSpace(alone(), 0.04).is_free(HOME)


def test_a_base_elsewhere_sees_the_same_scene_from_there():
    station = station_of([block(0.0, 0.0), Solid(box(0.1, 0.1, 0.3), (0.2, 0.0, 0.15))])
    first = CollisionWorld(station)
    turned = CollisionWorld(station, Pose(np.array([0.55, 0.0, 0.0]), quaternion_about_z(np.pi)))
    q = solve_ik(turned.chain, turned.in_base(down(0.2, 0.0, 0.1)), HOME, 1)[0]
    assert not CollisionSpace(turned, 0.04).is_free(q)
    assert CollisionSpace(first, 0.04).is_free(HOME)
    np.testing.assert_allclose(station.model.body_pos[station.base_body], first.base.position)  # left as it was


def test_spaces_of_one_world_do_not_disturb_each_other():
    world = clutter()
    rows = near_the_table(20)
    spaces = [CollisionSpace(world, 0.06), CollisionSpace(world, 0.02, margin_m=0.01)]
    alone_each = [[space.is_free(q) for q in rows] for space in spaces]
    mixed = [[space.is_free(q) for space in spaces] for q in rows]
    assert [list(row) for row in zip(*mixed, strict=True)] == alone_each


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 64, 101])
def test_every_step_of_an_edge_is_looked_at_once(count):
    assert sorted(_order_coarse_to_fine(count)) == list(range(1, count))
