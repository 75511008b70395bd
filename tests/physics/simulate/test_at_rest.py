"""Simulation against mechanics: free fall, rest, stacks, friction."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.physics.mjcf.slab import fit_slab
from tableverse_factory.physics.mjcf.spec import make_scene_body, make_simulation_spec
from tableverse_factory.physics.simulate import at_rest
from tableverse_factory.physics.simulate.at_rest import SPEED_LIMIT, measure_drift, simulate_to_rest
from tableverse_factory.physics.simulate.certificate import find_deepest_contact
from tests.helpers.simple_scenes import TABLE, UPRIGHT, ball, box

SLAB = fit_slab(TABLE, [], [], [])
CUBE = box(0.05, 0.05, 0.05)


def model_of(
    things: Sequence[tuple[TriangleMesh, tuple[float, float, float]]], masses: Sequence[float] | None = None
) -> mujoco.MjModel:
    bodies = [
        make_scene_body(
            f"obj_{k:03d}", mesh, (mesh,), 1.0, (masses or [0.2] * len(things))[k], Pose(np.array(at), UPRIGHT)
        )
        for k, (mesh, at) in enumerate(things)
    ]
    return make_simulation_spec(bodies, SLAB).compile()


def test_free_fall_takes_the_time_and_has_the_energy_of_free_fall() -> None:
    height, mass = 0.5, 0.2
    model = model_of([(CUBE, (0.0, 0.0, 1.0))], [mass])
    data = mujoco.MjData(model)
    g = -float(model.opt.gravity[2])
    while data.qpos[2] > 1.0 - height:
        mujoco.mj_step(model, data)
    fallen, speed = 1.0 - data.qpos[2], -data.qvel[2]
    assert data.time == pytest.approx(np.sqrt(2 * height / g), abs=2 * model.opt.timestep)
    assert mass * speed**2 / 2 == pytest.approx(mass * g * fallen, rel=0.01)


def test_a_box_just_above_the_table_comes_to_rest_on_it() -> None:
    rest = simulate_to_rest(model_of([(CUBE, (0.05, 0.03, 0.0255))]), 6.0)
    assert rest.at_rest
    assert rest.time_s < 1.0
    np.testing.assert_allclose(rest.poses[0].position, [0.05, 0.03, 0.025], atol=1e-4)
    np.testing.assert_allclose(rest.poses[0].quaternion_wxyz, UPRIGHT, atol=1e-4)


def test_a_stack_of_three_stands_and_a_heavy_top_does_not_sink_in() -> None:
    stack = [(CUBE, (0.0, 0.0, 0.0252 + 0.0502 * k)) for k in range(3)]
    model = model_of(stack, [0.05, 0.2, 2.0])
    rest = simulate_to_rest(model, 6.0)
    assert rest.at_rest
    for k, pose in enumerate(rest.poses):
        np.testing.assert_allclose(pose.position, [0.0, 0.0, 0.025 + 0.05 * k], atol=5e-4)
    drift = measure_drift(model, 5.0)
    assert drift.angle_rad.max() < 0.01


def test_what_weighs_grams_does_not_sink_under_what_weighs_a_kilogram() -> None:
    balls = [(ball(0.008), (x, 0.0, 0.008)) for x in (-0.04, 0.04)]
    model = model_of(
        [*balls, (ball(0.008), (0.0, 0.05, 0.008)), (box(0.14, 0.14, 0.1), (0.0, 0.015, 0.0665))], [0.008] * 3 + [1.5]
    )
    rest = simulate_to_rest(model, 6.0)
    assert rest.at_rest
    depth, pair = find_deepest_contact(model, rest.poses)
    assert depth < 1e-4, pair


def test_a_tall_box_on_a_bumpy_foot_stays_upright() -> None:
    mesh = box(0.04, 0.06, 0.2)
    bumps = mesh.vertices.copy()
    bumps[mesh.vertices[:, 2] < 0, 2] += [0.0, 0.002, 0.001, 0.0015]
    bumpy = TriangleMesh(bumps, mesh.faces)
    rest = simulate_to_rest(model_of([(bumpy, (0.0, 0.0, 0.1005))]), 6.0)
    assert rest.at_rest
    assert 2 * np.arccos(rest.poses[0].quaternion_wxyz[0]) < np.radians(4)


def test_settling_gently_closes_a_gap_without_a_kick() -> None:
    drop = [(CUBE, (0.0, 0.0, 0.025 + 0.05)), (ball(0.02), (0.1, 0.0, 0.07))]
    gentle = simulate_to_rest(model_of(drop), 6.0, gentle=True)
    assert gentle.at_rest
    assert np.linalg.norm(gentle.poses[0].position[:2]) < 1e-3
    assert np.linalg.norm(gentle.poses[1].position[:2] - [0.1, 0.0]) < 0.02


def test_what_has_no_time_is_not_at_rest_and_says_how_fast_it_is() -> None:
    rest = simulate_to_rest(model_of([(CUBE, (0.0, 0.0, 2.0))]), 0.5, gentle=False)
    assert not rest.at_rest
    assert rest.time_s == pytest.approx(0.5, abs=0.02)
    assert rest.speeds[0] == pytest.approx(9.81 * 0.5, rel=0.05)


def test_an_exploding_simulation_is_named() -> None:
    model = model_of([(CUBE, (0.0, 0.0, 0.025))])
    model.opt.gravity[:] = [0, 0, -1e12]
    assert "badq" in " ".join(simulate_to_rest(model, 1.0, gentle=False).warnings)


def test_drift_of_free_fall_is_half_g_t_squared() -> None:
    drift = measure_drift(model_of([(CUBE, (0.0, 0.0, 5.0))]), 0.5)
    assert drift.distance_m[0] == pytest.approx(9.81 * 0.125, rel=0.01)
    assert drift.sunk_m[0] == pytest.approx(drift.distance_m[0], rel=1e-6)
    assert drift.angle_rad[0] == pytest.approx(0.0, abs=1e-5)


STANDING = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 {height}"><freejoint/><geom type="{kind}" size="{size}"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize(
    ("kind", "size", "height", "stands"),
    [
        ("capsule", "0.01 0.08", 0.09, False),
        ("ellipsoid", "0.02 0.02 0.1", 0.1, False),
        ("box", "0.01 0.01 0.1", 0.1, True),
    ],
)
def test_what_stands_on_its_tip_is_not_at_rest_though_nothing_pushes_it(
    kind: str, size: str, height: float, stands: bool
) -> None:
    model = mujoco.MjModel.from_xml_string(STANDING.format(kind=kind, size=size, height=height))
    assert (measure_drift(model, 5.0).distance_m[0] < 0.001) == stands


EDGE = """
<mujoco>
  <asset>
    <mesh name="diamond" vertex="-.05 0 -.04 -.05 .02 0 -.05 0 .04 -.05 -.02 0
                                 .05 0 -.04 .05 .02 0 .05 0 .04 .05 -.02 0"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.04" euler="0 0 {heading}"><freejoint/><geom type="mesh" mesh="diamond"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize("heading", [0, 44.38238, 45, 90, 134.3, 135, 225.6176])
def test_what_stands_on_an_edge_falls_whatever_its_heading(heading: float) -> None:
    """At the odd ones a single nudge has no part across the edge."""
    assert measure_drift(mujoco.MjModel.from_xml_string(EDGE.format(heading=heading)), 5.0).distance_m[0] > 0.01


ROLLING = """
<mujoco>
  <option gravity="{slope} -9.81" timestep="{step}" cone="elliptic"/>
  <worldbody>
    <geom type="plane" size="1 1 0.1" friction="1 0 0"/>
    <body pos="0 0 0.05"><freejoint/><geom type="box" size="0.05 0.05 0.05"/></body>
    <body pos="0.4 0 0.03"><freejoint/><geom type="sphere" size="0.03"/></body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize("step", [0.001, 0.002])
@pytest.mark.parametrize("slope", ["1e-4 0", "-1e-4 0", "0 1e-4", "0 -1e-4", "-2e-5 0", "-3e-6 0"])
def test_sleep_hides_no_drift_and_is_over_afterwards(monkeypatch: pytest.MonkeyPatch, slope: str, step: float) -> None:
    """A ball begins to roll down a slope of 1 in 100,000, or first up: a millimetre in the end, at up to 0.4 mm/s."""
    model = mujoco.MjModel.from_xml_string(ROLLING.format(slope=slope, step=step))
    own = int(model.opt.enableflags), float(model.opt.sleep_tolerance)
    drift = measure_drift(model, 5.0)
    assert (int(model.opt.enableflags), float(model.opt.sleep_tolerance)) == own
    monkeypatch.setattr(at_rest, "DRIFT_SLEEP_TOLERANCE", 0.0)
    awake = measure_drift(model, 5.0)
    np.testing.assert_allclose(drift.distance_m, awake.distance_m, atol=25e-6)
    np.testing.assert_allclose(drift.angle_rad, awake.angle_rad, atol=25e-6 / 0.03)
    if "1e-4" in slope:
        monkeypatch.setattr(at_rest, "DRIFT_SLEEP_TOLERANCE", 1e-3)
        frozen = measure_drift(model, 5.0)
        assert frozen.distance_m[1] < 0.5 * awake.distance_m[1], "else this ball proves nothing"


def test_what_moves_is_followed_to_the_end_though_others_sleep() -> None:
    drift = measure_drift(model_of([(CUBE, (0.0, 0.0, 0.025)), (CUBE, (50.0, 0.0, 0.0))]), 5.0)
    assert drift.distance_m[0] < 1e-4
    assert drift.distance_m[1] == pytest.approx(9.81 * 12.5, rel=0.01)


def test_what_trembles_is_not_at_rest_however_slow_it_is() -> None:
    # On a spring, 100 rad/s, at no more than 8 mm/s: always slower than the limit, and at up to 0.8 m/s² never still.
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option gravity="0 0 0"/><worldbody><site name="wall"/>
        <body pos="0.10008 0 0"><freejoint/><geom size="0.02" mass="0.1"/><site name="ball"/></body></worldbody>
        <tendon><spatial stiffness="1000" springlength="0.1"><site site="wall"/><site site="ball"/></spatial></tendon>
        </mujoco>""")
    rest = simulate_to_rest(model, 1.0, gentle=False)
    assert rest.speeds[0] < SPEED_LIMIT
    assert not rest.at_rest
    assert rest.moving.tolist() == [True]


def test_what_falls_past_the_floor_ends_the_simulation() -> None:
    rest = simulate_to_rest(model_of([(CUBE, (5.0, 0.0, 0.5))]), 6.0, gentle=False, lost_below_m=-0.5)
    assert rest.time_s < 0.6
    assert not rest.at_rest
    assert rest.moving.tolist() == [True]


def test_the_handler_of_warnings_of_a_user_stays() -> None:
    heard: list[str] = []
    model = model_of([(CUBE, (0.0, 0.0, 0.025))])
    model.opt.gravity[:] = [0, 0, -1e12]
    mujoco.set_mju_user_warning(heard.append)
    try:
        mujoco.mj_step(model, at_rest.make_quiet_data(model), nstep=50)
    finally:
        mujoco.set_mju_user_warning(None)
    assert heard
