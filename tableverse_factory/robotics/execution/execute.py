"""Execution of a motion in physics, checked on the way and recorded."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, Pose
from schemas.trajectories import Motion, Phase, Verdict
from tableverse_factory.robotics.execution.arrays import MAX_DURATION_S, Recording
from tableverse_factory.robotics.execution.goal import Goal
from tableverse_factory.robotics.execution.monitor import StateSample
from tableverse_factory.robotics.execution.poses import compute_angles
from tableverse_factory.robotics.execution.rollout import Rollout, ServoCommands, build_commands
from tableverse_factory.robotics.execution.success import SuccessChecker
from tableverse_factory.robotics.robots.station import Station

MAX_SETTLE_S = 1.5  # time for the object to come to rest after the last sample of a motion [s]
TOO_LONG = "too_long"  # reason code of a motion that exceeds what arrays may hold and is not executed
MIN_RECORDED_MOTION_M = 0.0005
MIN_RECORDED_TURN_RAD = np.radians(0.5)  # other objects are recorded if they ever leave their start by more than this


@dataclass(frozen=True, slots=True, eq=False)
class RolloutResult(Frozen):
    """Verdict of a rollout, and the recording up to the sample that decided."""

    verdict: Verdict
    recording: Recording


def execute_and_check(station: Station, base: Pose, motion: Motion, goal: Goal) -> RolloutResult:
    """Execute a motion on the exported scene, with the base at a pose in the table frame, and check the goal.

    Deterministic. It ends at the first failure, or when the object has come to rest, at most `MAX_SETTLE_S` after the
    motion. A motion too long to be recorded fails as `too_long` before it starts.
    """
    commands = build_commands(motion)
    if motion.duration_s + MAX_SETTLE_S <= MAX_DURATION_S:
        return execute_commands(station, base, commands, goal, round(MAX_SETTLE_S / motion.step_s))
    detail = f"it takes {motion.duration_s:.1f} s, and at most {MAX_DURATION_S - MAX_SETTLE_S:g} s are executed"
    first = ServoCommands(motion.step_s, commands.targets[:1], commands.phases[:1])
    start = execute_commands(station, base, first, goal, 0)
    return replace(start, verdict=Verdict(False, Phase.PRE_GRASP.value, TOO_LONG, detail))


def execute_commands(station: Station, base: Pose, commands: ServoCommands, goal: Goal, more: int) -> RolloutResult:
    """Execute commands, repeating the last up to `more` times until the object is at rest."""
    execution = Rollout(station, base, commands, goal.x_id, goal.y_id)
    checker, taken = SuccessChecker(goal, execution), list[StateSample]()
    with closing(execution.samples(more)) as samples:
        for sample in samples:
            taken.append(sample)
            if not checker.update(sample) or (sample.index >= len(commands) - 1 and checker.at_rest):
                break
    return RolloutResult(
        checker.verdict(taken[-1]), _build_recording(taken, execution, station.arm.name, base, goal.max_disturbed_m)
    )


def _build_recording(
    samples: Sequence[StateSample], execution: Rollout, robot: str, base: Pose, max_disturbed_m: float
) -> Recording:
    moved = np.array([sample.moved_m.max(initial=0.0) for sample in samples])
    step_s, poses = execution.commands.step_s, np.array([sample.others for sample in samples])
    shown = _find_moved_objects(poses)
    return Recording(
        robot=robot,
        base=base,
        step_s=step_s,
        max_disturbed_m=max_disturbed_m,
        moved_ids=tuple(execution.others[k] for k in shown),
        moved_poses=poses[:, shown].astype(np.float32),
        command=np.array([sample.command for sample in samples]),
        phase=np.array([sample.phase for sample in samples], dtype=np.int32),
        time_s=(np.arange(len(samples)) * step_s).astype(np.float32),
        qpos=np.array([sample.qpos for sample in samples], dtype=np.float32),
        qvel=np.array([sample.qvel for sample in samples], dtype=np.float32),
        tcp=np.array([sample.tcp for sample in samples], dtype=np.float32),
        object_pose=np.array([sample.pose for sample in samples], dtype=np.float32),
        pads=np.array([sample.pads for sample in samples], dtype=np.uint8),
        disturbed_m=np.maximum.accumulate(moved).astype(np.float32),
    )


def _find_moved_objects(poses: Float64[np.ndarray, "t n 7"]) -> Int64[np.ndarray, " m"]:
    away = np.linalg.norm(poses[..., :3] - poses[0, :, :3], axis=2).max(axis=0)
    turned = compute_angles(poses[..., 3:], poses[0, :, 3:]).max(axis=0)
    return np.flatnonzero((away > MIN_RECORDED_MOTION_M) | (turned > MIN_RECORDED_TURN_RAD))
