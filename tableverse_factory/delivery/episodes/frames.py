"""An episode as the frames of a LeRobot dataset: what is seen, what is done next, when, and how it ends."""

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
    """A column of data/: its type, how many numbers it has, and their names."""

    dtype: str
    size: int
    names: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """As it stands in meta/info.json."""
        return {"dtype": self.dtype, "shape": [self.size], "names": list(self.names) if self.names else None}

    def arrow_type(self) -> pa.DataType:
        """One number is a scalar, several a list of fixed length."""
        kind = pa.type_for_alias(self.dtype)
        return kind if self.size == 1 else pa.list_(kind, self.size)


def features(arm: Arm) -> dict[str, Feature]:
    """Every column of data/ by name; `observation.…` and `action` are what policies take by themselves."""
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


def stride(recording: Recording, fps: int | None) -> tuple[int, int]:
    """Every how many samples a frame is taken, and the frames per second that this makes.

    Raises:
        InputError: `bad_fps` if the rhythm of the recording is no whole number per second, or no multiple of `fps`.
    """
    rate = round(1.0 / recording.step_s)
    if abs(rate * recording.step_s - 1.0) > 1e-6:
        raise InputError(f"a step of {recording.step_s} s is no whole number of frames per second", "bad_fps")
    if fps is None:
        return 1, rate
    if rate % fps:
        possible = ", ".join(str(rate // k) for k in range(1, rate + 1) if rate % k == 0)
        raise InputError(f"{fps} frames per second of a recording of {rate}: give one of {possible}", "bad_fps")
    return rate // fps, fps


def frame_samples(recording: Recording, every: int) -> list[int]:
    """The samples that become frames: the first, then every so many."""
    return list(range(0, len(recording), every))


def columns(recording: Recording, samples: Sequence[int], fps: int, success: bool) -> dict[str, np.ndarray]:
    """The columns of an episode that it decides by itself; `numbered` adds the others.

    A frame's action is the command that leads to the next frame: the state was measured just as the command of its
    own sample was reached. The last frame's action is the last command.

    Args:
        recording: Of the episode.
        samples: Those that become frames.
        fps: Frames per second.
        success: How it ended.
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


def numbered(values: dict[str, np.ndarray], episode: int, first: int, task: int) -> dict[str, np.ndarray]:
    """All columns of an episode.

    Args:
        values: Its own.
        episode: Its number.
        first: Number of its first frame in the whole dataset.
        task: Number of its sentence.
    """
    frame = values["frame_index"]
    return {
        **values,
        "episode_index": np.full_like(frame, episode),
        "index": first + frame,
        "task_index": np.full_like(frame, task),
    }


def table_of(values: dict[str, np.ndarray], known: dict[str, Feature]) -> pa.Table:
    """The columns as Arrow."""
    arrays = []
    for name, feature in known.items():
        flat = pa.array(np.ascontiguousarray(values[name]).reshape(-1), type=pa.type_for_alias(feature.dtype))
        arrays.append(flat if feature.size == 1 else pa.FixedSizeListArray.from_arrays(flat, feature.size))
    return pa.Table.from_arrays(arrays, schema=pa.schema([(name, f.arrow_type()) for name, f in known.items()]))
