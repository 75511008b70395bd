"""Whether what happened is a success, and what went wrong if not: decided sample by sample, as soon as it is sure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Pose
from schemas.trajectories import Phase, Verdict
from tableverse_factory.geometry.math.transforms import normalized_quaternion
from tableverse_factory.physics.simulate.at_rest import HOLD_S, SPEED_LIMIT
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS, Goal
from tableverse_factory.robotics.execution.monitor import Sample
from tableverse_factory.robotics.execution.rollout import Commands, Execution

MIN_LIFT_M = 0.03
"""Lifted is what stands at least so much higher at the end of the post-grasp phase than it stood."""

CARRIER_SHARE = 2.0
"""Where Y carries X in the end, Y and what touches Y may move by this multiple of `max_disturbed_m`: a bowl rocks when
something is put into it, and what lies in it makes room."""

FALL_M = 0.01
"""An object whose centre of mass is this far below the table top has fallen from it."""

LOST_S = 0.06
"""No finger touches the object for so long: it is dropped. A single step without contact is none."""

LAG_RAD = 0.03
"""Where the fingers close and open, and at the end, every joint stands within this of its target."""

BLOCKED_RAD = 0.25
"""Anywhere else: a servo follows fast motions late, by a small part of this."""

_PHASES = tuple(Phase)
_HELD = (Phase.PRE_PLACE, Phase.PLACE)
_STANDS = (Phase.GRASP, Phase.PLACE, Phase.POST_PLACE)


@dataclass(frozen=True, slots=True)
class Failure:
    """What went wrong first.

    Attributes:
        phase: In which.
        reason: Code: `simulation_unstable`, `servo_lag`, `not_grasped`, `slipped`, `dropped`, `disturbed`,
            `not_released`, `relation_missed` or `not_at_rest`.
        detail: One line with the values that decided.
    """

    phase: Phase
    reason: str
    detail: str


def allowances(goal: Goal, others: Sequence[str], touching: Sequence[str]) -> Float64[np.ndarray, " n"]:
    """How far each other object may be moved [m].

    Args:
        goal: What is to be achieved.
        others: Ids of all objects that are not carried.
        touching: Ids of those that touch the reference in the beginning.
    """
    wide = {goal.y_id, *touching} if goal.relation in RESTING_RELATIONS else set()
    return np.array([goal.max_disturbed_m * (CARRIER_SHARE if name in wide else 1.0) for name in others])


@dataclass(slots=True)
class SuccessChecker:
    """Looks at the samples of one execution, in their order, and remembers what it needs.

    Attributes:
        goal: What is to be achieved.
        execution: Whose samples are looked at.
        failure: What went wrong first; None as long as nothing did.
        at_rest: Whether the object was at rest for `HOLD_S` until now.
    """

    goal: Goal
    execution: Execution
    failure: Failure | None = None
    at_rest: bool = False
    _allowed_m: np.ndarray = field(init=False)
    _ends: dict[Phase, int] = field(init=False)
    _stood_m: float = 0.0
    _lifted_m: float = 0.0
    _disturbed_m: float = 0.0
    _lost_s: float = 0.0
    _still_s: float = 0.0

    def __post_init__(self) -> None:
        self._ends = {phase: self.execution.commands.last_of(phase) for phase in Phase}
        touching = self.execution.touching(self.goal.y_id)
        self._allowed_m = allowances(self.goal, self.execution.others, touching)

    def look(self, sample: Sample) -> bool:
        """Takes in the next sample; whether there is a reason to go on."""
        if sample.index == 0:
            self._stood_m = float(sample.center[2])
        step_s = self.execution.commands.step_s
        self._lifted_m = max(self._lifted_m, float(sample.center[2]) - self._stood_m)
        self._disturbed_m = max(self._disturbed_m, float(sample.moved_m.max(initial=0.0)))
        self._lost_s = 0.0 if sample.pads else self._lost_s + step_s
        self._still_s = self._still_s + step_s if np.abs(sample.velocity).max() < SPEED_LIMIT else 0.0
        self.at_rest = self._still_s >= HOLD_S - 1e-9
        self.failure = self._broken(sample) or self._disturbed(sample) or self._lost(sample) or self._unmet(sample)
        return self.failure is None

    def verdict(self, last: Sample) -> Verdict:
        """The end of it.

        Args:
            last: The last sample that was looked at.
        """
        failure = self.failure or self._missed(last)
        figures = {"lifted_m": self._lifted_m, "disturbed_m": self._disturbed_m}
        if failure is None:
            return Verdict(True, "", "", "", **figures)
        return Verdict(False, failure.phase.value, failure.reason, failure.detail, **figures)

    def _broken(self, sample: Sample) -> Failure | None:
        if sample.warnings:
            detail = f"MuJoCo warned of {', '.join(sample.warnings)}"
            return Failure(_PHASES[sample.phase], "simulation_unstable", detail)
        if sample.arm_error_rad > BLOCKED_RAD:
            detail = f"a joint is {sample.arm_error_rad:.3f} rad from its target on the way, more than {BLOCKED_RAD}"
            return Failure(_PHASES[sample.phase], "servo_lag", detail)
        return None

    def _disturbed(self, sample: Sample) -> Failure | None:
        if not (sample.moved_m > self._allowed_m).any() and sample.heights_m.min(initial=0.0) >= -FALL_M:
            return None
        fallen = np.flatnonzero(sample.heights_m < -FALL_M)
        beyond = np.flatnonzero(sample.moved_m > self._allowed_m)
        if len(fallen):
            detail = f"{self.execution.others[fallen[0]]} fell from the table"
        else:
            k = int(beyond[np.argmax(sample.moved_m[beyond])])
            moved, allowed = 1e3 * sample.moved_m[k], 1e3 * self._allowed_m[k]
            detail = f"{self.execution.others[k]} was moved by {moved:.1f} mm, more than {allowed:.1f} mm"
        return Failure(_PHASES[sample.phase], "disturbed", detail)

    def _lost(self, sample: Sample) -> Failure | None:
        phase = _PHASES[sample.phase]
        if phase not in _HELD or self._lost_s < LOST_S - 1e-9 or _released(self.execution.commands, sample.index):
            return None
        rise = 1e3 * (float(sample.center[2]) - self._stood_m)
        return Failure(phase, "dropped", f"no finger touched it for {self._lost_s:.2f} s; it was {rise:.0f} mm up")

    def _unmet(self, sample: Sample) -> Failure | None:
        """What has to be true where a phase ends."""
        phase = _PHASES[sample.phase]
        if sample.index != self._ends[phase]:
            return None
        if phase in _STANDS and sample.arm_error_rad > LAG_RAD:
            detail = f"a joint stands {sample.arm_error_rad:.3f} rad from its target, more than {LAG_RAD}"
            return Failure(phase, "servo_lag", detail)
        if phase is Phase.GRASP and sample.pads != 3:
            touching = "one finger touches" if sample.pads else "no finger touches"
            return Failure(phase, "not_grasped", f"{touching} it with the gripper closed")
        rise = float(sample.center[2]) - self._stood_m
        if phase is Phase.POST_GRASP and (rise < MIN_LIFT_M or not sample.pads):
            detail = f"it rose by {1e3 * rise:.1f} mm of at least {1e3 * MIN_LIFT_M:.0f} mm"
            return Failure(phase, "slipped", detail + ("" if sample.pads else ", and no finger touches it"))
        return None

    def _missed(self, last: Sample) -> Failure | None:
        """What has to be true in the end."""
        commands, goal = self.execution.commands, self.goal
        reference = last.others[self.execution.others.index(goal.y_id)]
        if (done := _PHASES[last.phase]) is not Phase.POST_PLACE or last.index < len(commands) - 1:
            return Failure(done, "relation_missed", f"the motion ends in its phase {done.value}")
        if last.pads:
            return Failure(Phase.POST_PLACE, "not_released", "a finger still touches it in the end")
        if last.center[2] < -FALL_M:
            return Failure(Phase.PLACE, "relation_missed", f"{goal.x_id} fell from the table")
        if not goal.holds(_pose(last.pose), _pose(reference)):
            x, y, z = 1e3 * last.center
            detail = (
                f"{goal.x_id} is not {goal.relation.value} {goal.y_id}; its centre is at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
            )
            return Failure(Phase.PLACE, "relation_missed", detail)
        if not self.at_rest:
            fastest = float(np.abs(last.velocity).max())
            detail = f"it moves at {fastest:.3f} m/s or rad/s, and rest is below {SPEED_LIMIT} for {HOLD_S} s"
            return Failure(Phase.POST_PLACE, "not_at_rest", detail)
        return None


def _released(commands: Commands, index: int) -> bool:
    """Whether the fingers were told to open at the place, at this sample or before."""
    last = min(index, len(commands) - 1)
    start = max(commands.last_of(Phase.PRE_PLACE), 0)
    return bool((np.diff(commands.targets[start : last + 1, -1]) > 1e-6).any())


def _pose(numbers: np.ndarray) -> Pose:
    return Pose(numbers[:3].copy(), normalized_quaternion(numbers[3:]))
