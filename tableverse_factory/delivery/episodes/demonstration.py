"""Episode as a robomimic demonstration: observations, actions, and the simulator's full state."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float32, Float64, Int64

from schemas.geometry import Frozen
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.version import __version__
from tableverse_factory.delivery.episodes.observation import pad_objects, read_object_poses
from tableverse_factory.delivery.episodes.pictures import take_recorded_pictures
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.station import PREFIX, build_station_spec

ENVIRONMENT = "tableverse_factory.gym:TableVerse/PickPlace-v0"
_GYM_TYPE = 2
_CAMERAS = {"front": "agentview", "wrist": "robot0_eye_in_hand", "scene": "scene"}
_CHANNELS = {"": "_image", "depth": "_depth", "instances": "_segmentation_instance"}
_XYZW = [0, 1, 2, 4, 5, 6, 3]


@dataclass(frozen=True, slots=True, eq=False)
class Demonstration(Frozen):
    """Episode of `n` samples."""

    actions: Float32[np.ndarray, "n k"]  # command that leads to the next sample, -1 to 1 between its limits; k = j + 1
    rewards: Float32[np.ndarray, " n"]  # 1 at the end of a success
    dones: Int64[np.ndarray, " n"]  # 1 at the end
    states: Float64[np.ndarray, "n s"]  # time, qpos and qvel of the model
    phases: Int64[np.ndarray, " n"]  # index into `Phase`
    observations: Mapping[str, np.ndarray]  # by name, each of shape (n, …)
    model: str  # MJCF of the scene with the arm in place
    assets: Mapping[str, bytes]  # files that the model references


@dataclass(frozen=True, slots=True)
class DemonstrationSetting:
    """Setting shared by all demonstrations of an export."""

    object_rows: int  # of states of objects, zeros behind those of the scene
    pictures: tuple[str, ...]  # names of `pictures.PICTURES`
    size: tuple[int, int]  # of pictures, height and width [px]


def build_demonstration(episode: Episode, arm: Arm, setting: DemonstrationSetting) -> Demonstration:
    """Build the episode's samples."""
    recording, count = episode.recording, len(episode.recording)
    files = episode.scene.files()
    spec = build_station_spec(files, arm)
    pedestal = spec.body(f"{PREFIX}pedestal")
    pedestal.pos, pedestal.quat = recording.base.position, recording.base.quaternion_wxyz
    model = spec.compile()
    low, high = compute_action_limits(arm)
    following = np.minimum(np.arange(count) + 1, count - 1)
    scaled = 2.0 * (recording.command[following] - low) / (high - low) - 1.0
    last = np.arange(count) == count - 1
    used = {mesh.file for mesh in spec.meshes} | {texture.file for texture in spec.textures}
    known = {name.removeprefix("assets/"): data for name, data in {**files, **spec.assets}.items()}
    return Demonstration(
        actions=np.clip(scaled, -1.0, 1.0).astype(np.float32),
        rewards=(last & bool(episode.row["success"])).astype(np.float32),
        dones=last.astype(np.int64),
        states=_build_states(model, episode, arm),
        phases=recording.phase.astype(np.int64),
        observations={
            **_build_observations(model, episode, len(arm.joint_names), setting.object_rows),
            **_take_pictures(episode, arm, setting),
        },
        model=spec.to_xml(),
        assets={name: known[name] for name in sorted(used) if name in known},
    )


def compute_action_limits(arm: Arm) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest command: joints [rad], then the opening [m]. Both of shape (j + 1,)."""
    return np.array([*arm.lower, 0.0]), np.array([*arm.upper, arm.max_opening_m])


def build_env_args(recording: Recording, arm: Arm, setting: DemonstrationSetting) -> dict[str, Any]:
    """Build robomimic's `env_args`: what `gymnasium.make` needs beside a dataset, and the meaning of the actions."""
    low, high = compute_action_limits(arm)
    shown = {"pictures": setting.pictures, "picture_size": setting.size} if setting.pictures else {}
    return {
        "env_name": ENVIRONMENT,
        "type": _GYM_TYPE,
        "env_version": __version__,
        "env_kwargs": {"robot": recording.robot, "max_objects": setting.object_rows, **shown},
        "control_freq": 1.0 / recording.step_s,
        "action_low": low.tolist(),
        "action_high": high.tolist(),
        "action_names": [*arm.joint_names, "gripper_opening_m"],
    }


def _build_states(model: mujoco.MjModel, episode: Episode, arm: Arm) -> np.ndarray:
    """Build the model's state at each sample; unmoved objects stand as exported, speeds are differences of poses."""
    recording, data = episode.recording, mujoco.MjData(model)
    joints = [model.joint(PREFIX + name) for name in (*arm.joint_names, *arm.finger_joints)]
    if recording.qpos.shape[1] != len(joints):
        raise InputError(f"{episode.name}: {recording.qpos.shape[1]} positions of {len(joints)} joints", "bad_arrays")
    at, moves = [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]
    qpos = np.tile(data.qpos, (len(recording), 1))
    qpos[:, at] = recording.qpos
    for name, poses in (
        *((name, recording.poses_of(name)) for name in recording.moved_ids),
        (str(episode.row["x_id"]), recording.object_pose),
    ):
        first = _find_free_joint(model, episode, name)
        qpos[:, first : first + 7] = poses
    qvel = np.zeros((len(recording), model.nv))
    for sample in range(1, len(recording)):
        mujoco.mj_differentiatePos(model, qvel[sample], recording.step_s, qpos[sample - 1], qpos[sample])
    qvel[:, moves] = recording.qvel
    return np.concatenate([recording.time_s[:, None].astype(np.float64), qpos, qvel], axis=1)


def _build_observations(
    model: mujoco.MjModel, episode: Episode, n_joints: int, object_rows: int
) -> dict[str, np.ndarray]:
    """Build low-dimensional observations under robosuite's names and, as there, with quaternions xyzw."""
    recording = episode.recording
    objects, tcp = pad_objects(read_object_poses(model, episode), object_rows), recording.tcp[:, _XYZW]
    return {
        "object": objects[..., _XYZW].reshape(len(recording), -1),
        "robot0_eef_pos": tcp[:, :3],
        "robot0_eef_quat": tcp[:, 3:],
        "robot0_gripper_qpos": recording.qpos[:, n_joints:],
        "robot0_gripper_qvel": recording.qvel[:, n_joints:],
        "robot0_joint_pos": recording.qpos[:, :n_joints],
        "robot0_joint_vel": recording.qvel[:, :n_joints],
    }


def _take_pictures(episode: Episode, arm: Arm, setting: DemonstrationSetting) -> dict[str, np.ndarray]:
    """Take the pictures of every sample, under robosuite's names."""
    if not setting.pictures:
        return {}
    taken = take_recorded_pictures(setting.pictures, episode, arm, setting.size, range(len(episode.recording)))
    return {name_picture(name): np.stack(pictures) for name, pictures in taken.items()}


def name_picture(name: str) -> str:
    """Name a picture as robosuite does."""
    camera, _, channel = name.partition("_")
    return _CAMERAS[camera] + _CHANNELS[channel]


def _find_free_joint(model: mujoco.MjModel, episode: Episode, name: str) -> int:
    """Find where an object's position and quaternion begin in qpos."""
    body = _find_body(model, episode, name)
    joint = int(body.jntadr[0])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise InputError(f"{episode.name}: {name[:80]!r} is no object that can move", "no_such_object")
    return int(model.jnt_qposadr[joint])


def _find_body(model: mujoco.MjModel, episode: Episode, name: str) -> Any:
    try:
        return model.body(name)
    except KeyError:
        raise InputError(f"{episode.name}: there is no object {name!r}"[:300], "no_such_object") from None
