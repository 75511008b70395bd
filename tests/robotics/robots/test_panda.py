"""Our arm against its published figures, and its servos and gripper in physics."""

import mujoco
import numpy as np
import pytest

from tableverse_factory.robotics.robots.panda import GRIP_FORCE_N, LAG_S, build_panda
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.blocks_on_table import Mover, block_files, reached

# Of the manufacturer's documentation (control interface, "Denavit-Hartenberg parameters" and "limits for Panda"):
# a [m], d [m] and alpha [rad] of joints 1 to 7 and of the flange, in Craig's convention.
A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088, 0.0)
D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0, 0.107)
ALPHA = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2, 0.0)
UPPER = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
LOWER = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
SPEED = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
ACCELERATION = (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
TORQUE = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)


def gripper_by_table(joints: np.ndarray) -> np.ndarray:
    """Gripper frame in the base's, as a product of the table's rows. Shape (4, 4)."""
    frame = np.eye(4)
    for a, d, alpha, theta in zip(A, D, ALPHA, [*joints, 0.0], strict=True):
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        frame = frame @ np.array(
            [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    c, s = np.cos(-np.pi / 4), np.sin(-np.pi / 4)  # the hand is turned by -45 degrees on the flange
    return frame @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0.1034], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def alone() -> mujoco.MjModel:
    return build_panda().spec().compile()


def test_forward_kinematics_are_those_of_the_published_table(alone: mujoco.MjModel) -> None:
    rng, data = np.random.default_rng(5), mujoco.MjData(alone)
    for _ in range(200):
        joints = rng.uniform(LOWER, UPPER)
        data.qpos[:7] = joints
        mujoco.mj_kinematics(alone, data)
        expected = gripper_by_table(joints)
        np.testing.assert_allclose(data.site("tcp").xpos, expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(data.site("tcp").xmat.reshape(3, 3), expected[:3, :3], atol=1e-6)


def test_at_home_the_gripper_points_down_in_front_of_the_base() -> None:
    frame = gripper_by_table(build_panda().home)
    np.testing.assert_allclose(frame[:3, 3], [0.307, 0.0, 0.487], atol=5e-4)
    np.testing.assert_allclose(frame[:3, 2], [0.0, 0.0, -1.0], atol=1e-9)


def test_limits_are_the_published_ones_and_hold_in_the_model(alone: mujoco.MjModel) -> None:
    arm = build_panda()
    np.testing.assert_array_equal(arm.lower, LOWER)
    np.testing.assert_array_equal(arm.upper, UPPER)
    np.testing.assert_array_equal(arm.max_velocity, SPEED)
    np.testing.assert_array_equal(arm.max_acceleration, ACCELERATION)
    np.testing.assert_array_equal(arm.max_torque, TORQUE)
    np.testing.assert_allclose(alone.jnt_range[:7], np.stack([LOWER, UPPER], axis=1))
    np.testing.assert_allclose(alone.actuator_forcerange[:7, 1], TORQUE)
    assert alone.jnt_limited.all()
    assert alone.actuator_forcelimited.all()
    assert arm.max_opening_m == pytest.approx(0.08)


def test_masses_and_inertias_are_those_of_matter(alone: mujoco.MjModel) -> None:
    assert 16.0 < alone.body_mass.sum() < 20.0
    for body in range(1, alone.nbody):
        a, b, c = sorted(alone.body_inertia[body])
        assert a > 0.0
        assert a + b >= c * (1 - 1e-9), alone.body(body).name
    data = mujoco.MjData(alone)
    rng = np.random.default_rng(0)
    for _ in range(50):
        data.qpos[:7] = rng.uniform(LOWER, UPPER)
        mujoco.mj_forward(alone, data)
        full = np.zeros((alone.nv, alone.nv))
        mujoco.mj_fullM(alone, data, full)
        assert np.linalg.eigvalsh(full).min() > 0.01


def test_home_touches_nothing_and_few_random_configurations_do(alone: mujoco.MjModel) -> None:
    data, rng, touching = mujoco.MjData(alone), np.random.default_rng(2), 0
    for joints in (build_panda().home, *rng.uniform(LOWER, UPPER, (500, 7))):
        data.qpos[:7], data.qpos[7:] = joints, 0.04
        mujoco.mj_fwdPosition(alone, data)
        assert not (joints is build_panda().home and data.ncon)
        touching += data.ncon > 0
    assert 10 < touching < 100  # arms do run into themselves, but nothing is always in the way


def test_the_gripper_shape_covers_all_that_touches_of_the_hand(alone: mujoco.MjModel) -> None:
    arm, data = build_panda(), mujoco.MjData(alone)
    rng = np.random.default_rng(3)
    for opening in (0.0, 0.03, 0.08):
        data.qpos[:7], data.qpos[7:] = arm.home, opening / 2
        mujoco.mj_kinematics(alone, data)
        tcp, turn = data.site("tcp").xpos, data.site("tcp").xmat.reshape(3, 3)
        centers, halves = arm.shape.boxes(opening)
        touching = [g for g in range(alone.ngeom) if alone.geom_contype[g]]
        bodies = {alone.body(name).id for name in ("hand", "finger_left", "finger_right")}
        for geom in (g for g in touching if alone.geom_bodyid[g] in bodies):
            corners = rng.uniform(-1, 1, (50, 3)) * alone.geom_size[geom]
            points = corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            inside = (np.abs(((points - tcp) @ turn)[:, None] - centers) <= halves + 1e-9).all(axis=2)
            assert inside.any(axis=1).all()
        gap = centers[1:, 1] - np.sign(centers[1:, 1]) * halves[1:, 1]
        assert np.abs(gap).min() == pytest.approx(opening / 2, abs=1e-9)


def test_servos_follow_on_the_same_path_a_moment_later() -> None:
    station = Station(block_files([((0.04, 0.04, 0.04), (0.1, 0.1))]), build_panda())
    mover = Mover(station)
    away = station.arm.home + np.array([0.8, 0.5, -0.4, 0.6, 0.5, 0.4, -0.6])
    rows = mover.go(away, 0.08, 1.2)
    delay = round(LAG_S / station.model.opt.timestep)
    assert np.abs(rows[delay:, 1] - rows[:-delay, 0]).max() < 0.004
    rows = mover.go(away, 0.08, 0.5)
    assert np.abs(rows[-1, 1] - away).max() < 1e-4
    assert np.abs(mover.data.qvel[station.joint_dof]).max() < 1e-3


@pytest.mark.parametrize(
    ("width", "mass"),
    [(0.076, 0.5), (0.03, 1.5), *(pytest.param(*its, marks=pytest.mark.slow) for its in ((0.04, 0.5), (0.006, 0.1)))],
)
def test_the_gripper_closes_on_a_block_and_lifts_it(width: float, mass: float) -> None:
    size = (width, 0.04, 0.06)
    station = Station(block_files([(size, (0.0, 0.0))], mass), build_panda())
    above = reached(station, (0.0, 0.0, 0.16), station.arm.home)
    at, up = reached(station, (0.0, 0.0, 0.035), above), reached(station, (0.0, 0.0, 0.2), above)
    mover, body = Mover(station), station.object_bodies["obj_000"]
    for joints, opening, seconds in ((above, 0.08, 1.5), (at, 0.08, 1.0), (at, 0.08, 0.2), (at, 0.0, 0.9)):
        mover.go(joints, opening, seconds)
    data = mover.data
    assert station.opening(data) == pytest.approx(width, abs=1e-3)
    touching = np.isin(data.contact.geom, station.finger_geoms).any(axis=1)
    assert np.abs(data.contact.dist[touching]).max() < 5e-4
    assert np.abs(data.qfrc_actuator[station.finger_dof]).max() <= GRIP_FORCE_N + 1e-6
    mover.go(up, 0.0, 1.0)
    mover.go(up, 0.0, 0.4)
    held = data.xpos[body] - data.site_xpos[station.tcp_site]
    assert data.xpos[body][2] > 0.18
    mover.go(up, 0.0, 2.0)
    assert np.linalg.norm(data.xpos[body] - data.site_xpos[station.tcp_site] - held) < 5e-4
    mover.go(up, 0.08, 0.5)
    mover.go(up, 0.08, 0.3)
    assert data.xpos[body][2] < 0.15  # and it lets go
