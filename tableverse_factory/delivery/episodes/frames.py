"""Episode as frames of a LeRobot dataset: state, action, time and outcome."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tableverse_factory.core.errors import InputError
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.robots.arm import Arm

STATE, ACTION = "observation.state", "action"
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, slots=True)
class Feature:
    """Column of data/: its type, number of components, and their names."""

    dtype: str
    size: int
    names: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the entry of meta/info.json."""
        return {"dtype": self.dtype, "shape": [self.size], "names": list(self.names) if self.names else None}


def list_features(arm: Arm) -> dict[str, Feature]:
    """List every column of data/; policies read `observation.…` and `action` by default."""
    joints = arm.joint_names
    return {
        STATE: Feature("float32", len(joints) + len(arm.finger_joints), (*joints, *arm.finger_joints)),
        ACTION: Feature("float32", len(joints) + 1, (*joints, "gripper_opening_m")),
        "tcp_pose": Feature("float32", 7, _POSE),
        "object_pose": Feature("float32", 7, _POSE),
        "phase": Feature("int64", 1),
        "next.done": Feature("bool", 1),
        "next.success": Feature("bool", 1),
        "timestamp": Feature("float32", 1),
        "frame_index": Feature("int64", 1),
        "episode_index": Feature("int64", 1),
        "index": Feature("int64", 1),
        "task_index": Feature("int64", 1),
    }


def compute_stride(recording: Recording, fps: int | None) -> tuple[int, int]:
    """Compute the samples per frame and the resulting frames per second; `fps` None takes every sample."""
    rate = round(1.0 / recording.step_s)
    if abs(rate * recording.step_s - 1.0) > 1e-6:
        raise InputError(f"a step of {recording.step_s} s is no whole number of frames per second", "bad_fps")
    if fps is None:
        return 1, rate
    if rate % fps:
        possible = ", ".join(str(rate // k) for k in range(1, rate + 1) if rate % k == 0)
        raise InputError(f"{fps} frames per second of a recording of {rate}: give one of {possible}", "bad_fps")
    return rate // fps, fps


def build_columns(recording: Recording, samples: Sequence[int], fps: int, success: bool) -> dict[str, np.ndarray]:
    """Build an episode's own columns; `number_columns` adds the others.

    A frame's action is the command that leads to the next frame, as a state is measured when its own command has just
    been reached. The last frame's action is the last command.
    """
    count = len(samples)
    following = [*samples[1:], len(recording) - 1]
    last = np.arange(count) == count - 1
    return {
        STATE: recording.qpos[samples],
        ACTION: recording.command[following].astype(np.float32),
        "tcp_pose": recording.tcp[samples],
        "object_pose": recording.object_pose[samples],
        "phase": recording.phase[samples].astype(np.int64),
        "next.done": last,
        "next.success": last & success,
        "timestamp": (np.arange(count) / fps).astype(np.float32),
        "frame_index": np.arange(count, dtype=np.int64),
    }


def number_columns(values: dict[str, np.ndarray], episode: int, first: int, task: int) -> dict[str, np.ndarray]:
    """Add the episode's number, the dataset-wide index from `first` on, and the task's number."""
    frame = values["frame_index"]
    return {
        **values,
        "episode_index": np.full_like(frame, episode),
        "index": first + frame,
        "task_index": np.full_like(frame, task),
    }


def build_frame_table(values: dict[str, np.ndarray], known: dict[str, Feature]) -> pa.Table:
    """Convert the columns to Arrow: scalars for features of one component, else lists of fixed length."""
    arrays = []
    for name, feature in known.items():
        flat = pa.array(np.ascontiguousarray(values[name]).reshape(-1), type=pa.type_for_alias(feature.dtype))
        arrays.append(flat if feature.size == 1 else pa.FixedSizeListArray.from_arrays(flat, feature.size))
    return pa.Table.from_arrays(arrays, names=list(known))
