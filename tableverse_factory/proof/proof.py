"""The proof of a motion: executed in physics, judged on the way, recorded."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import Motion, Verdict
from tableverse_factory.proof.arrays import Recording
from tableverse_factory.proof.goal import Goal
from tableverse_factory.proof.judge import Judge
from tableverse_factory.proof.rollout import Commands, Execution, Sample, commands_of
from tableverse_factory.robots.station import Station

REST_S = 1.5
"""The object has this long to come to rest after the last sample of a motion [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Proof(Frozen):
    """What a rollout gave.

    Attributes:
        verdict: Success, or what went wrong first.
        recording: Up to the sample that decided.
    """

    verdict: Verdict
    recording: Recording


def prove(station: Station, base: Pose, motion: Motion, goal: Goal) -> Proof:
    """Executes a motion on the exported scene and judges what happens.

    Deterministic: the same files, base, motion and goal give the same proof. It ends as soon as it has failed, and
    else when the object has come to rest, at most `REST_S` after the motion.

    Args:
        station: Scene and arm; its base is moved to `base`.
        base: The robot's base in the table frame.
        motion: Six phases of joint positions and openings.
        goal: What is to be true in the end.
    """
    return execute(station, base, commands_of(motion), goal, round(REST_S / motion.step_s))


def execute(station: Station, base: Pose, commands: Commands, goal: Goal, more: int) -> Proof:
    """The same for commands, the last of which is repeated up to `more` times until the object is at rest."""
    execution = Execution(station, base, commands, goal.x_id, goal.y_id)
    judge, taken = Judge(goal, execution), list[Sample]()
    with closing(execution.samples(more)) as samples:
        for sample in samples:
            taken.append(sample)
            if not judge.look(sample) or (sample.index >= len(commands) - 1 and judge.at_rest):
                break
    recording = _recorded(taken, station.arm.name, base, commands.step_s, goal.max_disturbed_m)
    return Proof(judge.verdict(taken[-1]), recording)


def _recorded(samples: Sequence[Sample], robot: str, base: Pose, step_s: float, max_disturbed_m: float) -> Recording:
    moved = np.array([sample.moved_m.max(initial=0.0) for sample in samples])
    return Recording(
        robot=robot,
        base=base,
        step_s=step_s,
        max_disturbed_m=max_disturbed_m,
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
