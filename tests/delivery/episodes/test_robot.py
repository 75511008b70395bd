"""Arrays name a robot: what they name is never opened or fetched, and the user can name it again."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.episodes.lerobot import LeRobotOptions, export_lerobot
from tableverse_factory.delivery.episodes.robomimic import RobomimicOptions, export_robomimic
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.robotics.execution.arrays import Recording, encode_recording
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.viz.gallery.motions import write_motions
from tests.helpers.recorded_dataset import recording, trajectory_row, write_recorded_dataset


@pytest.fixture(autouse=True)
def _soon():
    """To open a FIFO would take for ever."""
    signal.alarm(60)
    yield
    signal.alarm(0)


@pytest.fixture
def fifo(tmp_path) -> Path:
    path = tmp_path / "arm.xml"
    os.mkfifo(path)
    return path


def dataset_of(tmp_path: Path, robot: str) -> Path:
    made = replace(recording(9), robot=robot)
    return write_recorded_dataset(
        tmp_path / "out", {"a-1": [(trajectory_row("a-1", "task_000", True), encode_recording(made))]}
    )


def named(robot: str) -> Recording:
    return replace(recording(3), robot=robot)


@pytest.mark.parametrize("name", ["/etc/x.xml", "x.xml", "../x.xml", "menagerie:franka_emika_panda", "menagerie:x.xml"])
def test_what_is_not_ours_has_to_be_given(name):
    with pytest.raises(InputError) as refused:
        load_recorded_arm(named(name))
    assert refused.value.reason in ("robot_is_a_file", "robot_not_given")
    words = "has to be given with --robot" if ":" in name else "that has to be given"
    assert words in str(refused.value)
    assert load_recorded_arm(named(name), "panda") is load_arm("panda")


def test_our_own_arms_stay_themselves_whatever_is_given(fifo):
    assert load_recorded_arm(named("panda"), str(fifo)) is load_arm("panda")


def test_an_arm_with_other_joints_is_refused():
    other = recording(3)
    other = replace(other, command=other.command[:, 1:], qpos=other.qpos[:, 1:], qvel=other.qvel[:, 1:])
    with pytest.raises(InputError, match="6 joints, but panda has 7") as refused:
        load_recorded_arm(other)
    assert refused.value.reason == "another_robot"


def test_no_export_and_no_gallery_opens_the_file_that_arrays_name(tmp_path, fifo):
    dataset = open_dataset(dataset_of(tmp_path, str(fifo)))
    with pytest.raises(InputError, match="has to be given"):
        export_lerobot(dataset, tmp_path / "made", LeRobotOptions(width=32, height=24))
    with pytest.raises(InputError, match="has to be given"):
        export_robomimic(dataset, tmp_path / "made.hdf5", RobomimicOptions())
    (motion,) = write_motions(dataset.scene("a-1"), tmp_path, films=9)
    assert "has to be given" in motion.problem
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.xml", "out"]


@pytest.mark.slow  # every command with an arm of a file
@pytest.mark.heavy
def test_the_arm_of_a_file_is_given_again_to_every_command(tmp_path, run):
    spec = load_arm("panda").spec()
    spec.add_key(name="home", qpos=[*load_arm("panda").home, *load_arm("panda").finger_open])
    spec.compile()
    mine = tmp_path / "mine.xml"
    mine.write_text(spec.to_xml().replace('<size nkey="1"/>', ""))
    out = dataset_of(tmp_path, "/home/theirs/arm.xml")
    code, _, error = run("export", "robomimic", out, tmp_path / "made.hdf5")
    assert (code, "/home/theirs/arm.xml, that has to be given" in error) == (1, True)
    small = ("--width", "32", "--height", "24")
    assert run("export", "lerobot", out, tmp_path / "made", *small, "--robot", mine)[0] == 0
    assert run("export", "robomimic", out, tmp_path / "made.hdf5", "--robot", mine)[0] == 0
    code, *_ = run("report", out, "--dest", tmp_path / "gallery", "--jobs", "1", "--robot", mine)
    assert code == 0
    assert list((tmp_path / "gallery/pictures").glob("*task_000.webp"))
