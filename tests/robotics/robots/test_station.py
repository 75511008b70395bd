"""A scene with an arm in it is the same scene, and its base moves without compiling."""

import mujoco
import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.physics.mjcf.load import load_model
from tableverse_factory.robotics.robots.panda import build_panda
from tableverse_factory.robotics.robots.station import PREFIX, Station, build_station_spec
from tests.helpers.blocks_on_table import WIDE_TABLE, Mover, block_files

BLOCKS = [((0.05, 0.05, 0.08), (0.0, 0.1)), ((0.06, 0.03, 0.04), (0.12, -0.05)), ((0.04, 0.04, 0.12), (-0.15, 0.0))]
FILES = block_files(BLOCKS, 0.3, WIDE_TABLE)


def compiled_at(base: Pose) -> mujoco.MjModel:
    """The model as MuJoCo compiles it with the base there from the start."""
    spec = build_station_spec(FILES, build_panda())
    body = spec.body(f"{PREFIX}pedestal")
    body.pos, body.quat = base.position, base.quaternion_wxyz
    return spec.compile()


def test_a_base_that_was_moved_is_one_that_was_compiled_there() -> None:
    rng, station = np.random.default_rng(4), Station(FILES, build_panda())
    touched = 0
    for _ in range(4):
        base = Pose(np.array([*rng.uniform(-0.5, 0.5, 2), 0.0]), quaternion_about_z(float(rng.uniform(-3, 3))))
        station.place_base(base)
        model = compiled_at(base)
        for name in ("body_pos", "body_quat", "dof_invweight0", "body_invweight0", "geom_aabb", "bvh_aabb"):
            np.testing.assert_allclose(getattr(station.model, name), getattr(model, name), atol=1e-12)
        moved, fresh = station.data(), mujoco.MjData(model)
        for joints in rng.uniform(station.arm.lower, station.arm.upper, (60, 7)):
            for one, data in ((station.model, moved), (model, fresh)):
                station.set_arm(data, joints, 0.05)
                mujoco.mj_forward(one, data)
            np.testing.assert_allclose(moved.geom_xpos, fresh.geom_xpos, atol=1e-12)
            np.testing.assert_allclose(moved.geom_xmat, fresh.geom_xmat, atol=1e-12)
            np.testing.assert_array_equal(moved.contact.geom, fresh.contact.geom)
            np.testing.assert_allclose(moved.contact.dist, fresh.contact.dist, atol=1e-9)
            bodies = station.model.geom_bodyid[moved.contact.geom]
            touched += int((np.isin(bodies, station.arm_bodies).sum(axis=1) == 1).sum())
    assert touched > 50  # the arm did meet the table and the blocks


def test_a_base_moves_where_what_rests_may_sleep_too() -> None:
    awake, asleep = Station(FILES, build_panda()), Station(FILES, build_panda())
    asleep.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    for station in (awake, asleep):
        station.data()
        station.place_base(Pose(np.array([0.4, 0.3, 0.0]), quaternion_about_z(2.5)))
    movers = [Mover(station) for station in (awake, asleep)]
    np.testing.assert_array_equal(movers[0].data.geom_xpos, movers[1].data.geom_xpos)
    for mover in movers:
        mover.go(mover.station.arm.home + 0.1, 0.02, 0.5)
    np.testing.assert_allclose(movers[0].data.site_xpos, movers[1].data.site_xpos, atol=1e-6)


def test_moving_there_and_back_gives_the_same_bytes() -> None:
    station = Station(FILES, build_panda())
    model_before, home = station.model.body_pos.tobytes(), station.base
    mover = Mover(station)
    mover.go(station.arm.home + 0.1, 0.02, 0.4)
    station.place_base(Pose(np.array([0.3, 0.5, 0.0]), quaternion_about_z(-2.0)))
    station.place_base(home)
    assert station.model.body_pos.tobytes() == model_before
    again = Mover(station)
    again.go(station.arm.home + 0.1, 0.02, 0.4)
    assert again.data.qpos.tobytes() == mover.data.qpos.tobytes()


def test_objects_rest_as_certified_with_the_arm_beside_them() -> None:
    alone = load_model(FILES)
    data = mujoco.MjData(alone)
    station = Station(FILES, build_panda())
    own = station.data()
    for name, address in station.object_qpos.items():
        start = alone.jnt_qposadr[alone.joint(name).id]
        np.testing.assert_array_equal(own.qpos[address : address + 7], data.qpos[start : start + 7])
    mujoco.mj_step(station.model, own, nstep=1500)
    mujoco.mj_step(alone, data, nstep=1500)
    for name, body in station.object_bodies.items():
        np.testing.assert_allclose(own.xpos[body], data.body(name).xpos, atol=1e-6)
        np.testing.assert_allclose(own.xpos[body], station.data().xpos[body], atol=1e-4)
        assert station.model.body_mass[body] == pytest.approx(alone.body(name).mass[0])
    assert np.abs(own.qpos[station.joint_qpos] - station.arm.home).max() < 1e-6


def test_without_what_is_seen_the_model_simulates_the_same() -> None:
    plain, seen = Station(FILES, build_panda()), Station(FILES, build_panda(), visuals=True)
    assert plain.model.ngeom < seen.model.ngeom
    assert not ((plain.model.geom_contype == 0) & (plain.model.geom_conaffinity == 0)).any()
    data = [Mover(station) for station in (plain, seen)]
    for mover in data:
        mover.go(mover.station.arm.home - 0.2, 0.03, 0.5)
    np.testing.assert_allclose(data[0].data.qpos, data[1].data.qpos, atol=1e-9)


def test_objects_may_be_called_as_parts_of_the_arm() -> None:
    station = Station(block_files(BLOCKS, names=["link1", "hand", "panda"]), build_panda())
    assert station.object_ids == ("link1", "hand", "panda")
    assert not set(station.object_bodies.values()) & set(station.arm_bodies.tolist())
    assert len(station.arm_bodies) == 12  # pedestal, links 0 to 7, hand, two fingers


def test_openings_come_back() -> None:
    station = Station(FILES, build_panda())
    data = station.data()
    for opening in (0.0, 0.025, 0.08):
        station.set_arm(data, station.arm.home, opening)
        assert station.opening(data) == pytest.approx(opening, abs=1e-12)
    mover = Mover(station)
    for opening in (0.02, 0.0, 0.06):
        mover.go(station.arm.home, opening, 0.6)
        mover.go(station.arm.home, opening, 0.3)
        assert station.opening(mover.data) == pytest.approx(opening, abs=1e-4)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "there is no scene.xml"),
        ({"scene.xml": b'<mujoco><asset><mesh file="/etc/passwd"/></asset></mujoco>'}, "none of its files"),
        ({"scene.xml": b"<mujoco><worldbody><body/>"}, "does not load"),
        ({"scene.xml": b"\xff\xfe"}, "does not load"),
    ],
)
def test_a_scene_that_is_none_is_refused(files: dict[str, bytes], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Station(files, build_panda())
    assert caught.value.reason == "bad_mjcf"
