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
from tableverse_factory.robotics.execution.arrays import Recording, decode_recording
from tableverse_factory.robotics.execution.execute import execute_commands
from tableverse_factory.robotics.execution.goal import load_goal
from tableverse_factory.robotics.execution.poses import compute_angles
from tableverse_factory.robotics.execution.rollout import ServoCommands
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station


@dataclass(frozen=True, slots=True)
class ReplayDifference:
    """Largest differences at any sample between recording and replay; 0 on the recording machine.

    Attributes:
        object_m: Position of the carried or any other object [m].
        object_rad: Their orientations [rad].
        arm_rad: Joint positions [rad].
        tcp_m: Position of the gripper [m].
        disturbed_m: Largest displacement of any other object [m].
    """

    object_m: float
    object_rad: float
    arm_rad: float
    tcp_m: float
    disturbed_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Replay(Frozen):
    """Recorded and replayed motion.

    Attributes:
        verdict: Of the replay.
        saved: Recording as read.
        now: Recording of the replay; its length may differ.
        standing: Exported pose of each other object by id. Each of shape (7,).
    """

    verdict: Verdict
    saved: Recording
    now: Recording
    standing: Mapping[str, Float64[np.ndarray, "7"]]

    def find_unknown_objects(self) -> tuple[str, ...]:
        """List moved objects of the recording that the scene does not have."""
        return tuple(name for name in self.saved.moved_ids if name not in self.standing)

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


def replay_trajectory(
    files: Mapping[str, bytes], row: Mapping[str, Any], arrays: bytes, arm: Arm | None = None
) -> Verdict:
    """Return the verdict of a saved trajectory, from the exported scene and its own commands alone.

    Args:
        files: Of the scene by name: `scene.xml` and `assets/…` are read.
        row: Of trajectories/: `x_id`, `y_id` and `relation`.
        arrays: The file that `row["arrays"]` names.
        arm: The robot, where it came from a file; else it is found by its name in the arrays.

    Raises:
        InputError: `bad_arrays`, `bad_task`, `bad_scene` or `bad_mjcf`; or as `load_named_arm`.
    """
    saved = decode_recording(arrays, str(row.get("arrays")))
    return replay_recording(files, row, saved, Station(files, arm or load_named_arm(saved.robot))).verdict


def replay_recording(
    files: Mapping[str, bytes],
    row: Mapping[str, Any],
    saved: Recording,
    station: Station,
    max_disturbed_m: float | None = None,
) -> Replay:
    """Replay decoded arrays on a station of these files, and return both recordings.

    `max_disturbed_m` overrides the arrays' bound on other objects [m].
    """
    goal = load_goal(files, row, saved.max_disturbed_m if max_disturbed_m is None else max_disturbed_m)
    commands = ServoCommands(saved.step_s, saved.command, saved.phase)
    proof = execute_commands(station, saved.base, commands, goal, more=0)
    poses = station.data().qpos
    others = {name: at for name, at in station.object_qpos.items() if name != goal.x_id}
    return Replay(
        proof.verdict, saved, proof.recording, {name: poses[at : at + 7].copy() for name, at in others.items()}
    )


def load_named_arm(name: str) -> Arm:
    """Load the arm named in arrays of any origin: never from a file, as arrays could name any path.

    Raises:
        InputError: `robot_is_a_file` for the name of a file.
        ConfigError: for an unknown name.
    """
    if name.endswith(".xml") or "/" in name or "\\" in name:
        raise InputError(
            f"its robot came from a file, {sanitize_line(name, 100)}, that has to be given", "robot_is_a_file"
        )
    return load_arm(name)
