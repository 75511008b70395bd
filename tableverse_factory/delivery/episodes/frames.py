"""Episode as frames of a LeRobot dataset: state, action, time and outcome."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from tableverse_factory.core.errors import InputError
from tableverse_factory.delivery.episodes.observation import (
    build_state,
    name_objects,
    name_state,
    pad_objects,
    read_object_poses,
)
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.delivery.episodes.subtasks import SUBTASKS
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.robots.arm import Arm

STATE, OBJECTS, ACTION = "observation.state", "observation.environment_state", "action"


@dataclass(frozen=True, slots=True)
class Feature:
    """Column of data/: its type, number of components, and their names."""

    dtype: str
    size: int
    names: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the entry of meta/info.json."""
        return {"dtype": self.dtype, "shape": [self.size], "names": list(self.names) if self.names else None}


def list_features(arm: Arm, object_rows: int) -> dict[str, Feature]:
    """List every column of data/; policies read `observation.…` and `action` by default."""
    state, objects, commands = name_state(arm), name_objects(object_rows), (*arm.joint_names, "gripper_opening_m")
    return {
        STATE: Feature("float32", len(state), state),
        OBJECTS: Feature("float32", len(objects), objects),
        ACTION: Feature("float32", len(commands), commands),
        "phase": Feature("int64", 1),
        "subtask": Feature("string", 1),
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


def build_columns(
    episode: Episode, arm: Arm, samples: Sequence[int], fps: int, object_rows: int
) -> dict[str, np.ndarray]:
    """Build an episode's own columns; `number_columns` adds the others.

    A frame's action is the command that leads to the next frame, as a state is measured when its own command has just
    been reached. The last frame's action is the last command.
    """
    recording, count = episode.recording, len(samples)
    following = [*samples[1:], len(recording) - 1]
    last = np.arange(count) == count - 1
    objects = pad_objects(read_object_poses(episode.scene.model(), episode)[samples], object_rows)
    phase = recording.phase[samples].astype(np.int64)
    return {
        STATE: build_state(arm, recording.qpos[samples], recording.qvel[samples], recording.tcp[samples]),
        OBJECTS: objects.reshape(count, -1),
        ACTION: recording.command[following].astype(np.float32),
        "phase": phase,
        "subtask": np.array(list(SUBTASKS.values()))[phase],
        "next.done": last,
        "next.success": last & bool(episode.row["success"]),
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
