"""Forward as MuJoCo has it, inverse back to the pose; within limits, distinct, and the same each time."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import pose_from_matrix, rotation_angle, translate_pose
from tableverse_factory.robotics.motion.kinematics import (
    DISTINCT_RAD,
    LIMIT_MARGIN_RAD,
    build_chain,
    follow_poses,
    solve_ik,
)
from tests.helpers.examples import scale_examples
from tests.helpers.work_cells import HOME, alone, down

SEEDS = st.integers(0, 2**32 - 1)


def configuration(seed: int) -> np.ndarray:
    chain = alone().chain
    return np.random.default_rng(seed).uniform(chain.lower + LIMIT_MARGIN_RAD, chain.upper - LIMIT_MARGIN_RAD)


@pytest.mark.heavy
@given(SEEDS)
def test_forward_is_what_mujoco_says(seed):
    world, q = alone(), configuration(seed)
    data = world.station.data()
    world.station.set_arm(data, q, 0.04)
    mujoco.mj_kinematics(world.station.model, data)
    tcp = world.tcp(q)
    np.testing.assert_allclose(tcp.position, data.site_xpos[world.station.tcp_site], atol=1e-9)
    turned = np.empty(4)
    mujoco.mju_mat2Quat(turned, data.site_xmat[world.station.tcp_site])
    assert rotation_angle(tcp.quaternion_wxyz, turned) < 1e-6


@pytest.mark.heavy
@given(SEEDS)
@settings(max_examples=scale_examples(40))
def test_solutions_have_the_pose_within_limits_and_differ(seed):
    chain = alone().chain
    wanted = pose_from_matrix(chain.pose_matrix(configuration(seed)))
    found = solve_ik(chain, wanted, HOME, 4)
    for q in found:
        pose = pose_from_matrix(chain.pose_matrix(q))
        assert np.linalg.norm(pose.position - wanted.position) < 1e-4
        assert rotation_angle(pose.quaternion_wxyz, wanted.quaternion_wxyz) < 1e-3
        assert (q > chain.lower).all()
        assert (q < chain.upper).all()
    for k, q in enumerate(found):
        assert all(np.abs(q - other).max() > DISTINCT_RAD for other in found[:k])
    np.testing.assert_array_equal(found, solve_ik(chain, wanted, HOME, 4))


@pytest.mark.heavy
def test_poses_of_the_arm_itself_are_nearly_always_found():
    chain = alone().chain
    reachable = [pose_from_matrix(chain.pose_matrix(configuration(seed))) for seed in range(100)]
    assert sum(len(solve_ik(chain, pose, HOME, 1)) > 0 for pose in reachable) >= 97


def test_the_solution_nearest_to_where_the_arm_is_comes_first():
    world = alone()
    at_home = world.in_base(world.tcp(HOME))
    assert np.abs(solve_ik(world.chain, at_home, HOME, 4)[0] - HOME).max() < 1e-3


def test_what_is_out_of_reach_has_no_solution():
    far = Pose(np.array([2.0, 0.0, 0.3]), np.array([0.0, 1.0, 0.0, 0.0]))
    assert solve_ik(alone().chain, far, HOME, 4).shape == (0, 7)


def test_a_line_is_followed_without_a_jump_to_where_the_reach_ends():
    world = alone()
    start = solve_ik(world.chain, world.in_base(down(0.0, 0.0, 0.1)), HOME, 2)
    poses = [translate_pose(down(0.0, 0.0, 0.1), np.array([0.0, 0.0, 0.005 * k])) for k in range(1, 301)]
    rows, reached = follow_poses(world.chain, start, [world.in_base(pose) for pose in poses])
    assert (reached > 30).all()  # as far as a lift goes
    assert (reached < 300).all()  # 1.5 m are too many
    for branch, count in enumerate(reached):
        path = np.concatenate([start[branch][None], rows[:count, branch]])
        assert np.abs(np.diff(path, axis=0)).max() < 0.25
        end = world.tcp(path[-1])
        assert np.linalg.norm(end.position - poses[count - 1].position) < 1e-4


def test_sliding_joints_are_followed_too():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="b" pos="0 0 1"><body quat="0.9 0.1 0.3 0"><joint name="s" type="slide"
        axis="0 1 0" range="-1 1"/><geom size=".1"/><body pos=".1 .2 0"><joint name="h" axis="1 0 0" pos="0 .1 0"
        range="-2 2"/><geom size=".1"/><site name="t" pos="0 .3 .1"/></body></body></body></worldbody></mujoco>"""
    )
    limits = (np.array([-1.0, -2.0]), np.array([1.0, 2.0]))
    chain, data = build_chain(model, ("s", "h"), 1, 0, limits), mujoco.MjData(model)
    data.qpos[:] = [0.4, -0.7]
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(
        chain.pose_matrix(np.array([0.4, -0.7]))[:3, 3], data.site_xpos[0] - [0, 0, 1], atol=1e-12
    )
    with pytest.raises(ValueError, match="in this order"):
        build_chain(model, ("h", "s"), 1, 0, limits)
