"""A robomimic file read back by h5py and MuJoCo alone, field by field after its documented structure."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.episodes.demonstration import DemonstrationSetting, build_demonstration
from tableverse_factory.delivery.episodes.robomimic import RobomimicOptions, export_robomimic
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.robotics.robots.registry import load_arm
from tests.helpers.recorded_dataset import STEP_S, X_ID, Y_ID, recording

pytestmark = pytest.mark.heavy

SETTING = DemonstrationSetting(3, (), (24, 32))
LENGTHS = {"demo_0": 41, "demo_1": 31, "demo_2": 31}
OBSERVATIONS = {
    "object": 14,
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "robot0_gripper_qpos": 2,
    "robot0_gripper_qvel": 2,
    "robot0_joint_pos": 7,
    "robot0_joint_vel": 7,
}


@pytest.fixture(scope="module")
def made(out, tmp_path_factory) -> Path:
    dest = tmp_path_factory.mktemp("robomimic") / "made.hdf5"
    written = export_robomimic(open_dataset(out), dest, RobomimicOptions(failed=True))
    assert (written.demos, written.samples) == (3, sum(LENGTHS.values()))
    return dest


@pytest.fixture(scope="module")
def file(made):
    with h5py.File(made) as opened:
        yield opened


def test_data_holds_demonstrations_and_nothing_else(file):
    assert sorted(file["data"]) == sorted(LENGTHS)
    assert file["data"].attrs["total"] == sum(LENGTHS.values())
    arguments = json.loads(file["data"].attrs["env_args"])
    assert {"env_name", "type", "env_kwargs"} <= set(arguments)
    assert arguments["type"] == 2
    assert arguments["env_kwargs"] == {"robot": "panda", "max_objects": 2}
    assert arguments["control_freq"] == pytest.approx(1 / STEP_S)


@pytest.mark.parametrize("demo", LENGTHS)
def test_every_demonstration_has_the_documented_members(file, demo):
    group, length = file["data"][demo], LENGTHS[demo]
    assert group.attrs["num_samples"] == length
    assert sorted(group) == ["actions", "dones", "next_obs", "obs", "phase", "rewards", "states"]
    assert group["actions"].shape == (length, 8)
    assert np.abs(group["actions"][()]).max() <= 1.0
    assert group["dones"][()].tolist() == [0] * (length - 1) + [1]
    success = json.loads(group.attrs["ep_meta"])["success"]
    assert group["rewards"][()].tolist() == [0.0] * (length - 1) + [float(success)]
    for name, size in OBSERVATIONS.items():
        now, then = group["obs"][name][()], group["next_obs"][name][()]
        assert now.shape == then.shape == (length, size)
        assert (now[1:] == then[:-1]).all()
    assert sorted(group["obs"]) == sorted(group["next_obs"]) == list(OBSERVATIONS)


def read_masks(file):
    return {key: [name.decode() for name in file["mask"][key][()]] for key in file["mask"]}


def test_masks_tell_successes_from_failures(file):
    everything = ["demo_0", "demo_1", "demo_2"]
    assert read_masks(file) == {"success": ["demo_0", "demo_2"], "failed": ["demo_1"], "train": everything}
    assert file["mask/success"].dtype.kind == "S"


def test_phases_are_the_recorded_ones(file):
    assert file["data/demo_0/phase"][()].tolist() == recording().phase.tolist()


def test_actions_scale_back_to_the_commands(file):
    """Normalised between the limits that stand in env_args; each is the command that leads to the next sample."""
    limits = json.loads(file["data"].attrs["env_args"])
    low, high = np.array(limits["action_low"]), np.array(limits["action_high"])
    commands = low + (file["data/demo_0/actions"][()] + 1.0) / 2.0 * (high - low)
    assert np.abs(commands[:-1] - recording().command[1:]).max() < 1e-5
    assert len(limits["action_names"]) == 8


def test_the_model_and_its_states_show_what_was_observed(file):
    """Loaded from the file alone, the simulator in each state has gripper and object where obs says."""
    group = file["data/demo_0"]
    assets = {}
    file["assets/a-1"].visititems(lambda name, entry: assets.update({name: entry[()].tobytes()}))
    model = mujoco.MjModel.from_xml_string(group.attrs["model_file"], assets)
    data = mujoco.MjData(model)
    assert group["states"].shape == (41, 1 + model.nq + model.nv)
    for sample in (0, 13, 40):
        state = group["states"][sample]
        data.time, data.qpos[:], data.qvel[:] = state[0], state[1 : 1 + model.nq], state[1 + model.nq :]
        mujoco.mj_forward(model, data)
        assert data.time == pytest.approx(sample * STEP_S, abs=1e-6)
        assert data.site("robot/tcp").xpos == pytest.approx(group["obs/robot0_eef_pos"][sample], abs=1e-5)
        seen = group["obs/object"][sample]
        for body, first in (("obj_001", 0), ("obj_000", 7)):
            assert data.body(body).xpos == pytest.approx(seen[first : first + 3], abs=1e-6)
            assert data.body(body).xquat[[1, 2, 3, 0]] == pytest.approx(seen[first + 3 : first + 7], abs=1e-6)


def test_speeds_of_the_object_are_those_of_its_way(file):
    group = file["data/demo_0"]
    way = group["obs/object"][:, :3]
    names = [f"{name}" for name in ("obj_000", "obj_001")]
    model_nv = 2 * 6 + 7 + 2
    speeds = group["states"][:, -model_nv:][:, 6 * names.index("obj_001") :][:, :3]
    assert speeds[1:] == pytest.approx(np.diff(way, axis=0) / STEP_S, abs=1e-3)


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_pictures_are_observations_and_do_not_depend_on_the_number_of_processes(out, made, tmp_path, jobs):
    options = RobomimicOptions(pictures=("front", "wrist_depth", "front_instances"), width=16, height=12, jobs=jobs)
    export_robomimic(open_dataset(out), tmp_path / "seen.hdf5", options)
    with h5py.File(tmp_path / "seen.hdf5") as file:
        seen = file["data/demo_0/obs"]
        shapes = {name: (values.shape, values.dtype.name) for name, values in seen.items() if name not in OBSERVATIONS}
        arguments = json.loads(file["data"].attrs["env_args"])
        assert np.unique(seen["agentview_segmentation_instance"]).max() == 255
        assert not np.array_equal(seen["agentview_image"][0], seen["agentview_image"][40])
    assert shapes == {
        "agentview_image": ((41, 12, 16, 3), "uint8"),
        "agentview_segmentation_instance": ((41, 12, 16, 1), "uint8"),
        "robot0_eye_in_hand_depth": ((41, 12, 16, 1), "float32"),
    }
    assert arguments["env_kwargs"]["picture_size"] == [12, 16]
    if jobs > 1:
        export_robomimic(open_dataset(out), tmp_path / "alone.hdf5", replace(options, jobs=1))
        assert (tmp_path / "alone.hdf5").read_bytes() == (tmp_path / "seen.hdf5").read_bytes()


def test_the_same_bytes_again(out, made, tmp_path):
    export_robomimic(open_dataset(out), tmp_path / "again.hdf5", RobomimicOptions(failed=True))
    assert (tmp_path / "again.hdf5").read_bytes() == made.read_bytes()


def test_only_successes_are_taken_unless_failures_are_wanted(out, tmp_path):
    assert export_robomimic(open_dataset(out), tmp_path / "made.hdf5", RobomimicOptions()).demos == 2
    with h5py.File(tmp_path / "made.hdf5") as file:
        assert sorted(file["mask"]) == ["success", "train"]


def test_nothing_is_overwritten(out, tmp_path):
    (tmp_path / "made.hdf5").write_text("mine")
    with pytest.raises(InputError, match="already there"):
        export_robomimic(open_dataset(out), tmp_path / "made.hdf5", RobomimicOptions())
    assert (tmp_path / "made.hdf5").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["made.hdf5"]


def test_what_was_pushed_is_in_states_and_observations(out):
    taken = recording(pushed=True)
    row = {"x_id": X_ID, "y_id": Y_ID, "success": True, "scene_id": "a-1", "task_id": "task_000"}
    made = build_demonstration(Episode(row, open_dataset(out).scene("a-1"), taken), load_arm("panda"), SETTING)
    model = mujoco.MjModel.from_xml_string(made.model, dict(made.assets))
    at = int(model.joint(int(model.body(Y_ID).jntadr[0])).qposadr[0])
    pushed = taken.moved_poses[:, 0]
    assert made.states[:, 1 + at : 8 + at] == pytest.approx(pushed, abs=1e-7)
    assert made.observations["object"][:, 7:10] == pytest.approx(pushed[:, :3], abs=1e-7)
    assert (made.observations["object"][:, 14:] == 0).all(), "of a third object, which other scenes may have"
    speed = made.states[1:, 1 + model.nq + int(model.body(Y_ID).dofadr[0])]
    assert speed == pytest.approx(np.full(40, -0.06 / 40 / STEP_S), abs=1e-4)
    strange = Episode(row, open_dataset(out).scene("a-1"), replace(taken, moved_ids=("table",)))
    with pytest.raises(InputError, match="'table' is no object that can move"):
        build_demonstration(strange, load_arm("panda"), SETTING)
