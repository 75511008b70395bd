"""What a policy is told of robot and objects: the same numbers in the environment and in every export."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pyarrow.compute as pc
from jaxtyping import Float, Float32

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.physics.simulate.at_rest import find_free_bodies
from tableverse_factory.robotics.robots.arm import Arm

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def name_state(arm: Arm) -> tuple[str, ...]:
    """Name the components of `build_state`."""
    speeds = (f"{name}.speed" for name in arm.joint_names)
    return (*arm.joint_names, *speeds, "gripper_opening_m", *(f"tcp.{axis}" for axis in POSE))


def build_state(
    arm: Arm,
    qpos: Float[np.ndarray, "t m"],
    qvel: Float[np.ndarray, "t m"],
    tcp: Float[np.ndarray, "t 7"],
) -> Float32[np.ndarray, "t s"]:
    """Build the robot's state: joints [rad], their speeds [rad/s], opening [m], pose of the gripper (wxyz).

    `qpos` and `qvel` are of the joints and then of the fingers, `tcp` is in the table frame.
    """
    joints = len(arm.joint_names)
    opening = arm.compute_openings(qpos[:, joints:])
    return np.concatenate([qpos[:, :joints], qvel[:, :joints], opening[:, None], tcp], axis=1).astype(np.float32)


def order_objects(names: Sequence[str], x_id: str, y_id: str) -> tuple[str, ...]:
    """Put the object to carry first and the reference second; the others follow in the order of the model."""
    return (x_id, y_id, *(name for name in names if name not in (x_id, y_id)))


def name_objects(rows: int) -> tuple[str, ...]:
    """Name the components of flattened object states."""
    who = ("carried", "reference", *(f"other_{k}" for k in range(1, rows - 1)))
    return tuple(f"{name}.{axis}" for name in who[:rows] for axis in POSE)


def count_object_rows(dataset: Dataset) -> int:
    """Count the objects of the largest scene, finished or not: the rows that suffice for every one of them."""
    return int(pc.max(dataset.scenes.to_table(columns=["n_objects"])["n_objects"]).as_py() or 0)


def pad_objects(poses: Float[np.ndarray, "*t n 7"], rows: int) -> Float32[np.ndarray, "*t r 7"]:
    """Append rows of zeros to the poses of objects up to `rows`."""
    padded = np.zeros((*poses.shape[:-2], rows, 7), dtype=np.float32)
    padded[..., : poses.shape[-2], :] = poses
    return padded


def list_objects(model: mujoco.MjModel, episode: Episode) -> tuple[str, ...]:
    """List the objects of an episode's scene, whose model this is, as `order_objects`; InputError if one is absent."""
    names = [model.body(body).name for body in find_free_bodies(model)]
    x_id, y_id = str(episode.row["x_id"]), str(episode.row["y_id"])
    if absent := [name for name in (x_id, y_id, *episode.recording.moved_ids) if name not in names]:
        name = sanitize_line(absent[0], 80)
        raise InputError(f"{episode.name}: {name!r} is no object that can move", "no_such_object")
    return order_objects(names, x_id, y_id)


def read_object_poses(model: mujoco.MjModel, episode: Episode) -> Float32[np.ndarray, "t n 7"]:
    """Read the pose of every object at every sample: position [m] and quaternion wxyz in the table frame.

    They stand in the order of `order_objects`; `model` is of the scene. What did not move stands as exported.
    """
    recording, found = episode.recording, []
    for name in list_objects(model, episode):
        poses = recording.object_pose if name == episode.row["x_id"] else recording.poses_of(name)
        at = int(model.jnt_qposadr[model.body(name).jntadr[0]])
        found.append(np.tile(model.qpos0[at : at + 7], (len(recording), 1)) if poses is None else poses)
    return np.stack(found, axis=1).astype(np.float32)
