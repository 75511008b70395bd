"""A trajectory executed again from what was saved: the exported scene, a row and its arrays. Nothing is planned."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from schemas.geometry import Frozen
from schemas.trajectories import Verdict
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import Recording, read_arrays
from tableverse_factory.robotics.execution.execute import execute
from tableverse_factory.robotics.execution.goal import goal_of
from tableverse_factory.robotics.execution.poses import angles
from tableverse_factory.robotics.execution.rollout import Commands
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import arm_of
from tableverse_factory.robotics.robots.station import Station


@dataclass(frozen=True, slots=True)
class Difference:
    """Largest differences at any sample between what was saved and what happens now; 0 on the machine that saved it.

    Attributes:
        object_m: Of the position of the carried object, and of any other [m].
        object_rad: Of their orientations [rad].
        arm_rad: Of a joint [rad].
        tcp_m: Of the gripper's position [m].
        disturbed_m: Of the largest displacement of any other object [m].
    """

    object_m: float
    object_rad: float
    arm_rad: float
    tcp_m: float
    disturbed_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Replay(Frozen):
    """What was saved beside what happens now.

    Attributes:
        verdict: Of now.
        saved: As read.
        now: Recorded anew; shorter or longer where it ended otherwise.
        standing: Where the other objects stand as exported, by id: position, quaternion. Each of shape (7,).
    """

    verdict: Verdict
    saved: Recording
    now: Recording
    standing: Mapping[str, Float64[np.ndarray, "7"]]

    def strangers(self) -> tuple[str, ...]:
        """Objects that were saved as moved, and are none of the scene's others."""
        return tuple(name for name in self.saved.moved_ids if name not in self.standing)

    def difference(self) -> Difference:
        """How far it is from what was saved."""
        saved, now, length = self.saved, self.now, min(len(self.saved), len(self.now))
        others = sorted({*saved.moved_ids, *now.moved_ids}.intersection(self.standing))
        pairs = [(self._where(saved, name, length), self._where(now, name, length)) for name in others]
        pairs.append((saved.object_pose[:length], now.object_pose[:length]))
        joints = saved.command.shape[1] - 1
        return Difference(
            max(_apart(a, b) for a, b in pairs),
            max(float(angles(a[:, 3:], b[:, 3:]).max()) for a, b in pairs),
            float(np.abs(saved.qpos[:length, :joints] - now.qpos[:length, :joints]).max()),
            _apart(saved.tcp[:length], now.tcp[:length]),
            float(np.abs(saved.disturbed_m[:length] - now.disturbed_m[:length]).max()),
        )

    def _where(self, recording: Recording, name: str, length: int) -> Float[np.ndarray, "t 7"]:
        poses = recording.poses_of(name)
        return np.tile(self.standing[name], (length, 1)) if poses is None else poses[:length]


def _apart(a: Float[np.ndarray, "t 7"], b: Float[np.ndarray, "t 7"]) -> float:
    return float(np.linalg.norm(a[:, :3] - b[:, :3], axis=1).max())


def replay(files: Mapping[str, bytes], row: Mapping[str, Any], arrays: bytes, arm: Arm | None = None) -> Verdict:
    """The verdict of a saved trajectory, from the exported scene and its own commands alone.

    Args:
        files: Of the scene by name: `scene.xml` and `assets/…` are read.
        row: Of trajectories/: `x_id`, `y_id` and `relation`.
        arrays: The file that `row["arrays"]` names.
        arm: The robot, where it came from a file; else it is found by its name in the arrays.

    Raises:
        InputError: `bad_arrays`, `bad_task`, `bad_scene` or `bad_mjcf`, with what is wrong; or as `named_arm`.
    """
    saved = read_arrays(arrays, str(row.get("arrays")))
    return replayed(files, row, saved, Station(files, arm or named_arm(saved.robot))).verdict


def replayed(
    files: Mapping[str, bytes],
    row: Mapping[str, Any],
    saved: Recording,
    station: Station,
    max_disturbed_m: float | None = None,
) -> Replay:
    """The same with the states of then and now.

    Args:
        files: As in `replay`.
        row: As in `replay`.
        saved: The arrays, read.
        station: Of these files and the saved robot; what was executed on it before makes no difference.
        max_disturbed_m: The bound that other objects have to keep; that of the arrays where it is None [m].
    """
    goal = goal_of(files, row, saved.max_disturbed_m if max_disturbed_m is None else max_disturbed_m)
    commands = Commands(saved.step_s, saved.command, saved.phase)
    proof = execute(station, saved.base, commands, goal, more=0)
    poses = station.data().qpos
    others = {name: at for name, at in station.object_qpos.items() if name != goal.x_id}
    return Replay(
        proof.verdict, saved, proof.recording, {name: poses[at : at + 7].copy() for name, at in others.items()}
    )


def named_arm(name: str) -> Arm:
    """The arm that arrays of any origin name: never a file, which anybody's arrays could point to.

    Raises:
        InputError: `robot_is_a_file` for the name of a file.
        ConfigError: for no name of an arm.
    """
    if name.endswith(".xml") or "/" in name or "\\" in name:
        raise InputError(
            f"its robot came from a file, {sanitize_line(name, 100)}, that has to be given", "robot_is_a_file"
        )
    return arm_of(name)
