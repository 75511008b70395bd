"""The proof of a motion: executed in physics, judged on the way, recorded."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, Pose
from schemas.trajectories import Motion, Phase, Verdict
from tableverse_factory.robotics.execution.arrays import MAX_DURATION_S, Recording
from tableverse_factory.robotics.execution.goal import Goal
from tableverse_factory.robotics.execution.monitor import Sample
from tableverse_factory.robotics.execution.poses import angles
from tableverse_factory.robotics.execution.rollout import Commands, Execution, commands_of
from tableverse_factory.robotics.execution.success import SuccessChecker
from tableverse_factory.robotics.robots.station import Station

REST_S = 1.5
"""The object has this long to come to rest after the last sample of a motion [s]."""


TOO_LONG = "too_long"
"""Code of a motion that is not executed: it has no end within what arrays may hold."""

SHOWN_M = 0.0005
SHOWN_RAD = np.radians(0.5)
"""The poses of other objects are recorded where they ever leave their start by more than this."""


@dataclass(frozen=True, slots=True, eq=False)
class Proof(Frozen):
    """What a rollout gave.

    Attributes:
        verdict: Success, or what went wrong first.
        recording: Up to the sample that decided.
    """

    verdict: Verdict
    recording: Recording


def execute_and_check(station: Station, base: Pose, motion: Motion, goal: Goal) -> Proof:
    """Executes a motion on the exported scene and judges what happens.

    Deterministic: the same files, base, motion and goal give the same proof. It ends as soon as it has failed, and
    else when the object has come to rest, at most `REST_S` after the motion. A motion that could not be recorded for
    its length fails as `too_long` before it starts.

    Args:
        station: Scene and arm; its base is moved to `base`.
        base: The robot's base in the table frame.
        motion: Six phases of joint positions and openings.
        goal: What is to be true in the end.
    """
    commands = commands_of(motion)
    if motion.duration_s + REST_S <= MAX_DURATION_S:
        return execute(station, base, commands, goal, round(REST_S / motion.step_s))
    detail = f"it takes {motion.duration_s:.1f} s, and at most {MAX_DURATION_S - REST_S:g} s are executed"
    start = execute(station, base, Commands(motion.step_s, commands.targets[:1], commands.phases[:1]), goal, 0)
    return replace(start, verdict=Verdict(False, Phase.PRE_GRASP.value, TOO_LONG, detail))


def execute(station: Station, base: Pose, commands: Commands, goal: Goal, more: int) -> Proof:
    """The same for commands, the last of which is repeated up to `more` times until the object is at rest."""
    execution = Execution(station, base, commands, goal.x_id, goal.y_id)
    judge, taken = SuccessChecker(goal, execution), list[Sample]()
    with closing(execution.samples(more)) as samples:
        for sample in samples:
            taken.append(sample)
            if not judge.look(sample) or (sample.index >= len(commands) - 1 and judge.at_rest):
                break
    return Proof(judge.verdict(taken[-1]), _recorded(taken, execution, station.arm.name, base, goal.max_disturbed_m))


def _recorded(
    samples: Sequence[Sample], execution: Execution, robot: str, base: Pose, max_disturbed_m: float
) -> Recording:
    moved = np.array([sample.moved_m.max(initial=0.0) for sample in samples])
    step_s, poses = execution.commands.step_s, np.array([sample.others for sample in samples])
    shown = _seen_to_move(poses)
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


def _seen_to_move(poses: Float64[np.ndarray, "t n 7"]) -> Int64[np.ndarray, " m"]:
    away = np.linalg.norm(poses[..., :3] - poses[0, :, :3], axis=2).max(axis=0)
    turned = angles(poses[..., 3:], poses[0, :, 3:]).max(axis=0)
    return np.flatnonzero((away > SHOWN_M) | (turned > SHOWN_RAD))
