"""Other people's arms: read, measured, used; and refused with the reason where something is missing."""

import os
from pathlib import Path

import numpy as np
import pytest

from schemas.geometry import Pose
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.robotics.motion.kinematics import solve_ik
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld
from tableverse_factory.robotics.robots.base import find_bases
from tableverse_factory.robotics.robots.panda import build_panda
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.blocks_on_table import WIDE_TABLE, Mover, block_files
from tests.helpers.six_axis_arm import HOME, six_axes

BLOCKS = [((0.03, 0.03, 0.05), (0.0, 0.0))]


def test_a_file_becomes_an_arm(tmp_path: Path) -> None:
    path = six_axes(tmp_path)
    arm = load_arm(str(path))
    assert arm.name == str(path)
    assert arm.joint_names == ("a", "b", "c", "d", "e", "f")
    np.testing.assert_allclose(arm.home, HOME, atol=1e-5)
    np.testing.assert_allclose(arm.upper, np.full(6, 2.6))  # what the actuators take, a little less than the joints
    np.testing.assert_array_equal(arm.max_velocity, np.full(6, 2.0))
    np.testing.assert_array_equal(arm.max_torque, np.full(6, 90.0))
    assert arm.max_opening_m == pytest.approx(0.06, abs=1e-6)
    assert arm.gripper_control == (0.0, 255.0)
    assert arm.base_radius_m == pytest.approx(0.09, abs=1e-3)
    np.testing.assert_allclose(arm.shape.finger_centers, [[0.0, 0.005, -0.02]], atol=1e-7)
    np.testing.assert_allclose(arm.shape.hand_half_sizes, [[0.03, 0.06, 0.02]], atol=1e-9)
    np.testing.assert_allclose(arm.shape.pad_half_size_xz, [0.01, 0.01], atol=1e-7)


def test_settings_of_the_file_s_own_simulation_do_not_count(tmp_path: Path) -> None:
    odd = (
        '<option integrator="implicit"/>',
        '<option integrator="Euler" timestep="1e-9" gravity="5 0 0"/><size nuserdata="3"/>'
        '<visual><map znear="3"/></visual>',
    )
    arm = load_arm(str(six_axes(tmp_path / "odd", odd)))
    plain = load_arm(str(six_axes(tmp_path / "plain")))
    assert arm.max_opening_m == plain.max_opening_m
    station = Station(block_files(BLOCKS), arm)
    assert station.model.opt.timestep == 0.002
    assert station.model.opt.gravity.tolist() == [0.0, 0.0, -9.81]


def test_it_works_in_a_station_with_openings_in_metres(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    six_axes(tmp_path)
    monkeypatch.chdir(tmp_path)
    arm = load_arm("arm.xml")
    monkeypatch.chdir("/")
    station = Station(block_files(BLOCKS, table=WIDE_TABLE), arm, visuals=True)
    station.place_base(find_bases(station, np.array([[0.0, 0.0, 0.05]]))[0])
    mover = Mover(station)
    mover.go(arm.home + 0.2, 0.02, 1.0)
    rows = mover.go(arm.home + 0.2, 0.02, 1.0)
    assert np.abs(rows[-1, 1] - arm.home - 0.2).max() < 1e-3  # held against gravity
    assert station.opening(mover.data) == pytest.approx(0.02, abs=1e-3)
    assert station.model.opt.integrator == station.model.opt.integrator.__class__(3)  # the scene's own


def test_motions_are_planned_within_what_the_actuators_can_be_told(tmp_path: Path) -> None:
    """A joint that could turn by 150 degrees and more, whose actuator takes 34 only."""
    narrow = ('name="a" joint="a"', 'name="a" joint="a" ctrlrange="-0.6 0.6"')
    arms = {"wide": load_arm(str(six_axes(tmp_path / "w"))), "narrow": load_arm(str(six_axes(tmp_path / "n", narrow)))}
    stations = {name: Station(block_files(BLOCKS, table=WIDE_TABLE), arm) for name, arm in arms.items()}
    worlds = {
        name: CollisionWorld(station, Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))) for name, station in stations.items()
    }
    for name, arm in arms.items():
        np.testing.assert_array_equal(worlds[name].chain.lower, arm.lower)
        np.testing.assert_array_equal(worlds[name].chain.upper, arm.upper)
    turned = arms["wide"].home.copy()
    turned[0] = 1.2
    target = worlds["wide"].tcp(turned)
    assert len(solve_ik(worlds["wide"].chain, target, turned, 4))
    kept = solve_ik(worlds["narrow"].chain, target, turned, 4)
    assert (np.abs(kept[:, 0]) < 0.6).all()
    ahead, side = (np.where(np.arange(6) == 0, angle, arms["wide"].home) for angle in (-0.5, 0.5))
    path = RrtConnect().plan_path(ahead, side, CollisionSpace(worlds["narrow"], 0.05), np.random.default_rng(0))
    assert path is not None
    assert (np.abs(path[:, 0]) <= 0.6).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<site name="tcp" pos="0 0 0.09"/>', "", "no site 'tcp'"),
        ('<site name="tcp" pos="0 0 0.09"/>', '<site name="tcp" pos="0 0 0.3"/>', "between the fingertips"),
        ('<joint name="c"/>', '<joint name="c" type="slide"/>', "'c' must be a hinge"),
        ('<joint name="c"/>', '<joint name="c" limited="false"/>', "'c' must be a hinge with a range"),
        ('<general class="collision" name="d" joint="d"/>', "", "'d' has 0 actuators"),
        ('<general class="collision" name="d" joint="d"/>', '<motor name="d" joint="d"/>', "'d' does not control"),
        ('name="d" joint="d"', 'name="d" joint="d" gear="2"', "'d' does not control its position"),
        ('name="d" joint="d"', 'name="d" joint="d" dyntype="integrator"', "'d' does not control its position"),
        ('name="f" joint="f"', 'name="f" joint="f" forcelimited="false"', "'f' needs a forcerange"),
        ('name="grip" tendon="split"', 'name="grip" tendon="split" ctrllimited="false"', "'grip' needs a ctrlrange"),
        ('<key name="home"', '<key name="away"', "no keyframe 'home'"),
        ('<key name="home" qpos="0.0', '<key name="home" qpos="3', "outside the joints' limits"),
        ('data="2"', 'data="2 -1"', "'max_velocity'"),
        (
            '<joint name="a" axis="0 0 1"/>',
            '<joint name="a" axis="0 0 1"/><joint name="x" class="finger"/>',
            "'x' must",
        ),
        (
            '<body name="foot" childclass="collision">',
            '<body name="foot" childclass="collision"><freejoint/>',
            "has a joint",
        ),
        ('<light name="top"', '<body name="cart"><geom size="0.1"/></body><light name="top"', "more than one body"),
        ('class="finger" mass="0.05"', 'class="finger" mass="0.05" contype="0" conaffinity="0"', "touches anything"),
        ('pos="0 0.005 0.03"', 'pos="0 0.02 0.03"', "apart"),
        ('<joint name="right" class="finger"/>', '<joint name="right" class="finger" axis="1 0 0"/>', "along its y"),
        ('gainprm="0.0117647058824 0 0"', 'gainprm="0 0 0"', "moves the fingers by"),
        ('<exclude body1="left" body2="right"/>', "", ""),
        ('fromto="0 0 0.03 0 0 0.2" size="0.04"', 'fromto="0 0 0.03 0 0 0.5" size="0.04"', "at home"),
        ('name="a" joint="a"', 'joint="a"', "has no name"),
        ("</mujoco>", "", "does not load"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = six_axes(tmp_path, (old, new))
    if not message:  # the fingers may touch each other in the file: they are apart at home
        assert load_arm(str(path)).max_opening_m > 0.05
        return
    with pytest.raises(InputError, match=message) as caught:
        load_arm(str(path))
    assert str(caught.value).startswith("arm.xml: ")
    assert caught.value.reason in ("bad_robot", "bad_mjcf")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("hostile", ["/etc/passwd", "../../secret.obj", "/dev/zero"])
def test_an_arm_s_file_reads_nothing_outside_its_folder(tmp_path: Path, hostile: str) -> None:
    folder = tmp_path / "a" / "b"
    path = six_axes(folder, ('file="foot.obj"', f'file="{hostile}"'))
    (tmp_path / "secret.obj").write_bytes((folder / "assets" / "foot.obj").read_bytes())
    with pytest.raises(InputError, match=r"outside|no regular file") as caught:
        load_arm(str(path))
    assert caught.value.reason == "bad_mjcf"


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    path = six_axes(tmp_path / "arm")
    mesh = path.parent / "assets" / "foot.obj"
    mesh.rename(tmp_path / "foot.obj")
    mesh.symlink_to(tmp_path / "foot.obj")
    with pytest.raises(InputError, match="outside"):
        load_arm(str(path))


def test_names_that_are_none_say_what_would_be_right(tmp_path: Path) -> None:
    assert load_arm("panda") is build_panda()
    with pytest.raises(ConfigError, match="'panda', 'menagerie:NAME' or a file"):
        load_arm("pandas")
    with pytest.raises(InputError, match="is no file"):
        load_arm(str(tmp_path / "none.xml"))


def test_the_menagerie_is_read_through_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A local checkout of one robot, as the package takes it; its file has no site, ours is known for this name."""
    pytest.importorskip("mujoco_menagerie")
    six_axes(
        tmp_path / "franka_emika_panda",
        ('<body name="left" pos="0 0 0.04">', '<body name="left" pos="0 0 0.0534">'),
        ('<body name="right" pos="0 0 0.04"', '<body name="right" pos="0 0 0.0534"'),
        tcp=False,
        name="panda.xml",
    )
    monkeypatch.setenv("MENAGERIE_ROOT", os.fspath(tmp_path))
    arm = load_arm("menagerie:franka_emika_panda")
    assert arm.name == "menagerie:franka_emika_panda"
    assert arm.max_opening_m == pytest.approx(0.06, abs=1e-6)
    np.testing.assert_allclose(arm.shape.pad_half_size_xz, [0.01, 0.01], atol=1e-6)
    with pytest.raises(ConfigError, match="Did you mean 'franka_emika_panda'"):
        load_arm("menagerie:franka_emika_pandas")
    with pytest.raises(ConfigError, match="ufactory_xarm7"):
        load_arm("menagerie:ufactory_xarm7")


def test_without_the_package_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco_menagerie", None)
    with pytest.raises(ConfigError, match=r"pip install 'tableverse-factory\[robots\]'"):
        load_arm("menagerie:kuka_iiwa_14")
