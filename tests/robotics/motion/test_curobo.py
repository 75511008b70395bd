"""Obstacles in the robot's frame, as meshes or boxes; and a clear word where cuRobo is not installed."""

import importlib.util
from functools import lru_cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.core.errors import ModelError
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    identity_pose,
    quaternion_about_z,
    transform_points,
)
from tableverse_factory.robotics.motion.curobo import _describe_obstacle
from tableverse_factory.robotics.motion.dynamics import CarriedObject
from tableverse_factory.robotics.motion.interfaces import PLANNERS
from tableverse_factory.robotics.motion.obstacles import build_obstacle, list_obstacles, merge_object_pieces
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.simple_scenes import Solid, box
from tests.helpers.work_cells import BLOCK, HOME, block, down, station_of

TURNED = (0.9, 0.1, -0.3, 0.2)


@lru_cache(maxsize=1)
def station() -> Station:
    tilted = Solid(box(0.1, 0.2, 0.06), (0.1, -0.1, 0.2), object_id="tilted", quaternion=TURNED)
    return station_of([block(-0.2, 0.1), tilted])


def world(base: Pose | None = None) -> CollisionWorld:
    return CollisionWorld(station(), base)


@pytest.mark.heavy
@settings(max_examples=25)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3))
def test_an_obstacle_seen_from_the_base_is_where_it_is_on_the_table(x, y, yaw):
    base = Pose(np.array([x, y, 0.0]), quaternion_about_z(yaw))
    here = world(base)
    found = {obstacle.name: obstacle for obstacle in list_obstacles(CollisionSpace(here, 0.04))}
    assert set(found) == {"table", BLOCK, "tilted"}
    for name in (BLOCK, "tilted"):
        on_table = transform_points(here.object_pose(name), found[name].mesh.vertices)
        from_base = transform_points(found[name].pose, found[name].mesh.vertices)
        np.testing.assert_allclose(transform_points(base, from_base), on_table, atol=1e-9)
    top = compose_poses(base, found["table"].box_pose).position[2] + found["table"].size[2] / 2
    assert top == pytest.approx(0.0, abs=1e-9)


def test_the_mesh_is_the_object_as_it_was_exported():
    mesh = merge_object_pieces(world(), "tilted")
    np.testing.assert_allclose(np.abs(mesh.vertices).max(axis=0), [0.05, 0.1, 0.03], atol=1e-6)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(0.1 * 0.2 * 0.06, rel=1e-4)


def test_the_distance_to_the_robot_is_the_same_in_both_frames():
    here = world()
    tcp = here.chain.pose_matrix(HOME)[:3, 3]
    for obstacle in list_obstacles(CollisionSpace(here, 0.04)):
        if obstacle.mesh is not None:
            seen = transform_points(obstacle.pose, obstacle.mesh.vertices)
            real = transform_points(here.object_pose(obstacle.name), obstacle.mesh.vertices)
            np.testing.assert_allclose(
                np.linalg.norm(seen - tcp, axis=1), np.linalg.norm(real - here.tcp(HOME).position, axis=1), atol=1e-9
            )


def test_what_is_carried_is_no_obstacle_and_what_was_let_go_stands_there():
    here = world()
    carried = CarriedObject(BLOCK, identity_pose())
    assert BLOCK not in {obstacle.name for obstacle in list_obstacles(CollisionSpace(here, 0.04, carried=carried))}
    there = Pose(np.array([0.2, 0.2, 0.05]), identity_pose().quaternion_wxyz)
    moved = next(o for o in list_obstacles(CollisionSpace(here, 0.04, standing={BLOCK: there})) if o.name == BLOCK)
    np.testing.assert_allclose(compose_poses(here.base, moved.pose).position, there.position, atol=1e-9)


def test_a_bad_mesh_is_its_box_and_says_why():
    good = box(0.1, 0.2, 0.3)
    shift = TriangleMesh(good.vertices + np.array([1.0, 0.0, 0.0]), good.faces)
    pose = down(0.1, 0.2, 0.3, 0.5)
    assert build_obstacle("good", pose, shift).mesh is shift
    flat = TriangleMesh(shift.vertices * [1.0, 1.0, 0.0], shift.faces)
    faults = {
        "open": TriangleMesh(shift.vertices, shift.faces[:-1]),
        "no surface": TriangleMesh(shift.vertices, shift.faces[:0]),
        "not manifold": TriangleMesh(shift.vertices, np.concatenate([shift.faces[:1, ::-1], shift.faces[1:]])),
    }
    for why, mesh in faults.items():
        boxed = build_obstacle("bad", pose, mesh)
        assert (boxed.mesh, boxed.boxed) == (None, why)
        np.testing.assert_allclose(boxed.size, [0.1, 0.2, 0.3], atol=1e-9)
        np.testing.assert_allclose(boxed.box_pose.position, transform_points(pose, np.array([[1.0, 0.0, 0.0]]))[0])
    assert build_obstacle("flat", pose, flat).mesh is None
    assert build_obstacle("none", pose, TriangleMesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32))).mesh is None


def test_arguments_are_plain_lists_with_the_quaternion_real_part_first():
    table, thing, *_ = list_obstacles(CollisionSpace(world(), 0.04))
    arguments = _describe_obstacle(thing)
    np.testing.assert_allclose(arguments["pose"], [*thing.pose.position, *thing.pose.quaternion_wxyz])
    assert isinstance(arguments["vertices"], list)
    assert isinstance(arguments["faces"][0], list)
    assert _describe_obstacle(table)["dims"] == table.size.tolist()


@pytest.mark.skipif(importlib.util.find_spec("curobo") is not None, reason="cuRobo is installed here")
def test_without_the_package_the_message_says_what_to_do():
    with pytest.raises(ModelError, match="rrt needs none"):
        PLANNERS["curobo"]()
