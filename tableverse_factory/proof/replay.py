"""A trajectory executed again from what was saved: the exported scene, a row and its arrays. Nothing is planned."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.geometry import Frozen
from schemas.trajectories import Verdict
from tableverse_factory.errors import InputError
from tableverse_factory.proof.arrays import Recording, read_arrays
from tableverse_factory.proof.goal import goal_of
from tableverse_factory.proof.proof import execute
from tableverse_factory.proof.rollout import Commands
from tableverse_factory.robots.arm import Arm
from tableverse_factory.robots.doors import arm_of
from tableverse_factory.robots.station import Station
from tableverse_factory.text import printable


@dataclass(frozen=True, slots=True, eq=False)
class Replay(Frozen):
    """What was saved beside what happens now.

    Attributes:
        verdict: Of now.
        saved: As read.
        now: Recorded anew; shorter or longer where it ended otherwise.
    """

    verdict: Verdict
    saved: Recording
    now: Recording

    def difference(self) -> tuple[float, float]:
        """Largest distance of the object's position [m] and of a joint [rad] from what was saved, at any sample."""
        length = min(len(self.saved), len(self.now))
        object_m = np.linalg.norm(self.saved.object_pose[:length, :3] - self.now.object_pose[:length, :3], axis=1)
        joints = self.saved.command.shape[1] - 1
        arm_rad = np.abs(self.saved.qpos[:length, :joints] - self.now.qpos[:length, :joints])
        return float(object_m.max()), float(arm_rad.max())


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


def replayed(files: Mapping[str, bytes], row: Mapping[str, Any], saved: Recording, station: Station) -> Replay:
    """The same with the states of then and now.

    Args:
        files: As in `replay`.
        row: As in `replay`.
        saved: The arrays, read.
        station: Of these files and the saved robot; what was executed on it before makes no difference.
    """
    goal = goal_of(files, row, saved.max_disturbed_m)
    commands = Commands(saved.step_s, saved.command, saved.phase)
    proof = execute(station, saved.base, commands, goal, more=0)
    return Replay(proof.verdict, saved, proof.recording)


def named_arm(name: str) -> Arm:
    """The arm that arrays of any origin name: never a file, which anybody's arrays could point to.

    Raises:
        InputError: `robot_is_a_file` for the name of a file.
        ConfigError: for no name of an arm.
    """
    if name.endswith(".xml") or "/" in name or "\\" in name:
        raise InputError(f"its robot came from a file, {printable(name, 100)}, that has to be given", "robot_is_a_file")
    return arm_of(name)
