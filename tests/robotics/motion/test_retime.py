"""Curves: smooth, straight where they were, never far from the corners. Timing: within every limit, rest to rest."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tableverse_factory.robotics.motion.dynamics import ArmDynamics, CarriedObject
from tableverse_factory.robotics.motion.retime import TORQUE_SHARE, retime_curve
from tableverse_factory.robotics.motion.segments import blend_path
from tableverse_factory.robotics.robots.panda import build_panda
from tests.helpers.simple_scenes import Solid, box
from tests.helpers.work_cells import BLOCK, HOME, alone, down, held_pose, station_of

SPEED, STEP_S = 0.5, 0.02


def corners(seed: int, count: int) -> np.ndarray:
    return HOME + np.cumsum(np.random.default_rng(seed).normal(0, 0.25, (count, 7)), axis=0) * (np.arange(7) != 3)


@pytest.mark.heavy
@given(st.integers(0, 1000), st.integers(2, 6), st.sampled_from([0.5, 0.1, 0.03]))
@settings(max_examples=30)
def test_a_blend_keeps_the_ends_and_stays_near_the_corners(seed, count, radius):
    path = corners(seed, count)
    curve = blend_path(path, radius, touch_at_start=True, touch_at_end=False)
    marks = np.linspace(curve.t[0], curve.t[-1], 400)
    values = curve(marks)
    np.testing.assert_allclose(values[[0, -1]], path[[0, -1]], atol=1e-12)
    assert (values >= path.min(axis=0) - 1e-12).all()  # no overshoot
    assert (values <= path.max(axis=0) + 1e-12).all()
    dense = np.concatenate([a + (b - a) * np.linspace(0, 1, 200)[:, None] for a, b in pairwise(path)])
    away = np.linalg.norm(values[:, None] - dense[None], axis=2).min(axis=1)
    assert away.max() < radius + 0.01
    acceleration = curve.derivative(2)(np.linspace(curve.t[0], curve.t[-1], 20001))
    jumps = np.abs(np.diff(acceleration, axis=0)).max()
    assert jumps < 0.05 * max(np.abs(acceleration).max(), 1e-9) + 1e-9  # continuous to the second derivative


def test_a_straight_line_stays_one_at_unit_speed():
    path = np.array([HOME, HOME + 0.1, HOME + 0.4])
    curve = blend_path(path, 0.2, touch_at_start=True, touch_at_end=True)
    marks = np.linspace(curve.t[0], curve.t[-1], 50)
    np.testing.assert_allclose(np.linalg.norm(curve.derivative(1)(marks), axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(curve.derivative(2)(marks), 0.0, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("mass_kg", [0.0, 3.0])
def test_timing_holds_every_limit_and_is_at_rest_at_both_ends(seed, mass_kg):
    arm = build_panda()
    dynamics, load = ArmDynamics(arm), None
    station = station_of([Solid(box(0.05, 0.05, 0.1), (0.0, 0.0, 0.05), object_id=BLOCK)], max(mass_kg, 0.1))
    if mass_kg:
        load = CarriedObject(BLOCK, held_pose(down(0.0, 0.0, 0.07), alone().object_pose(BLOCK)))
    dynamics.set_payload(station, load)
    curve = blend_path(corners(seed, 4), 0.2, touch_at_start=False, touch_at_end=True)
    timed = retime_curve(curve, arm, dynamics, SPEED, STEP_S)
    q, v = timed.positions, timed.velocities
    assert np.abs(v[[0, -1]]).max() == 0.0
    assert (np.abs(v) <= SPEED * arm.max_velocity).all()
    acceleration = np.diff(v, axis=0) / STEP_S
    assert (np.abs(acceleration) <= SPEED * arm.max_acceleration * (1 + 1e-9)).all()
    mean = (v[1:] + v[:-1]) / 2
    assert (np.abs(np.diff(q, axis=0) / STEP_S - mean) <= 0.5 * SPEED * arm.max_acceleration * STEP_S).all()
    assert (np.diff(timed.places) >= 0.0).all()
    torques = np.array(
        [dynamics.compute_torques(*row) for row in zip(q, v, np.gradient(v, STEP_S, axis=0), strict=True)]
    )
    assert (np.abs(torques) <= arm.max_torque).all()
    assert 0.3 < len(q) * STEP_S < 10.0


def test_a_load_that_is_near_the_limit_slows_the_motion_down():
    arm = build_panda()
    path = np.array([HOME, HOME + np.array([0.0, 0.9, 0.0, 0.4, 0.0, 0.0, 0.0])])
    curve, times = blend_path(path, 0.2, touch_at_start=False, touch_at_end=False), []
    for mass_kg in (0.1, 8.0):
        dynamics = ArmDynamics(arm)
        station = station_of([Solid(box(0.05, 0.05, 0.1), (0.0, 0.0, 0.05), object_id=BLOCK)], mass_kg)
        dynamics.set_payload(station, CarriedObject(BLOCK, held_pose(down(0.0, 0.0, 0.07), alone().object_pose(BLOCK))))
        timed = retime_curve(curve, arm, dynamics, 1.0, STEP_S)
        times.append(np.inf if timed is None else len(timed.positions))
    assert times[1] > times[0]
    assert TORQUE_SHARE < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_torques_are_those_of_mujoco_with_the_object_welded_on(seed):
    """The load is the object's own mass and inertia where it hangs, the arm's weight not compensated."""
    arm, rng = build_panda(), np.random.default_rng(seed)
    station = station_of([Solid(box(0.05, 0.06, 0.1), (0.0, 0.0, 0.05), object_id=BLOCK)], 1.5)
    hang = held_pose(down(0.01, 0.02, 0.08, 0.4), alone().object_pose(BLOCK))
    dynamics = ArmDynamics(arm)
    dynamics.set_payload(station, CarriedObject(BLOCK, hang))
    spec = arm.spec()
    for body in spec.bodies:
        body.gravcomp = 0.0
    site = spec.site(arm.tcp_site)
    at_site = site.parent.add_body(pos=site.pos, quat=site.quat)
    block = at_site.add_body(pos=hang.position, quat=hang.quaternion_wxyz)
    source, held = station.model, station.object_bodies[BLOCK]
    block.mass, block.inertia = source.body_mass[held], source.body_inertia[held]
    block.ipos, block.iquat, block.explicitinertial = source.body_ipos[held], source.body_iquat[held], True
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model = spec.compile()
    data = mujoco.MjData(model)
    q, v, a = HOME + rng.normal(0, 0.2, 7), rng.normal(0, 1, 7), rng.normal(0, 3, 7)
    joints = [model.joint(name).id for name in arm.joint_names]
    data.qpos[model.jnt_qposadr[joints]], data.qvel[model.jnt_dofadr[joints]] = q, v
    data.qacc[model.jnt_dofadr[joints]] = a
    mujoco.mj_inverse(model, data)
    np.testing.assert_allclose(
        dynamics.compute_torques(q, v, a), data.qfrc_inverse[model.jnt_dofadr[joints]], atol=1e-6
    )
