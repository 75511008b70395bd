"""Replay of a saved trajectory from the exported scene, a row and its arrays, without planning."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from schemas.geometry import Frozen
from schemas.trajectories import Verdict
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.execution.execute import execute_commands
from tableverse_factory.robotics.execution.goal import load_goal
from tableverse_factory.robotics.execution.poses import compute_angles
from tableverse_factory.robotics.execution.rollout import ServoCommands
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station


@dataclass(frozen=True, slots=True)
class ReplayDifference:
    """Largest differences at any sample between recording and replay; 0 on the recording machine."""

    object_m: float  # position of the carried or any other object
    object_rad: float  # their orientations
    arm_rad: float  # joint positions
    tcp_m: float  # position of the gripper
    disturbed_m: float  # largest displacement of any other object


@dataclass(frozen=True, slots=True, eq=False)
class Replay(Frozen):
    """Recorded and replayed motion, perhaps of different lengths."""

    verdict: Verdict  # of the replay
    saved: Recording
    now: Recording
    standing: Mapping[str, Float64[np.ndarray, "7"]]  # exported pose of each other object by id

    def compute_difference(self) -> ReplayDifference:
        """Compute how far the replay is from the recording."""
        saved, now, length = self.saved, self.now, min(len(self.saved), len(self.now))
        others = sorted({*saved.moved_ids, *now.moved_ids}.intersection(self.standing))
        pairs = [(self._where(saved, name, length), self._where(now, name, length)) for name in others]
        pairs.append((saved.object_pose[:length], now.object_pose[:length]))
        joints = saved.command.shape[1] - 1
        return ReplayDifference(
            max(_compute_max_distance(a, b) for a, b in pairs),
            max(float(compute_angles(a[:, 3:], b[:, 3:]).max()) for a, b in pairs),
            float(np.abs(saved.qpos[:length, :joints] - now.qpos[:length, :joints]).max()),
            _compute_max_distance(saved.tcp[:length], now.tcp[:length]),
            float(np.abs(saved.disturbed_m[:length] - now.disturbed_m[:length]).max()),
        )

    def _where(self, recording: Recording, name: str, length: int) -> Float[np.ndarray, "t 7"]:
        poses = recording.poses_of(name)
        return np.tile(self.standing[name], (length, 1)) if poses is None else poses[:length]


def _compute_max_distance(a: Float[np.ndarray, "t 7"], b: Float[np.ndarray, "t 7"]) -> float:
    return float(np.linalg.norm(a[:, :3] - b[:, :3], axis=1).max())


def replay_recording(
    files: Mapping[str, bytes],
    row: Mapping[str, Any],
    saved: Recording,
    station: Station,
    max_disturbed_m: float | None = None,
) -> Replay:
    """Replay decoded arrays of a row of trajectories/ on a station of the exported scene's files.

    `max_disturbed_m` overrides the arrays' bound on other objects [m].
    """
    goal = load_goal(files, row, saved.max_disturbed_m if max_disturbed_m is None else max_disturbed_m)
    commands = ServoCommands(saved.step_s, saved.command, saved.phase)
    proof = execute_commands(station, saved.base, commands, goal, more=0)
    poses = station.data().qpos
    standing = {name: poses[at : at + 7].copy() for name, at in station.object_qpos.items() if name != goal.x_id}
    return Replay(proof.verdict, saved, proof.recording, standing)


def load_named_arm(name: str) -> Arm:
    """Load the arm named in arrays of any origin: never from a file, as arrays could name any path."""
    if name.endswith(".xml") or "/" in name or "\\" in name:
        raise InputError(
            f"its robot came from a file, {sanitize_line(name, 100)}, that has to be given", "robot_is_a_file"
        )
    return load_arm(name)
