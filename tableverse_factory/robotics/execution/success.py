"""Success criteria of an executed motion, decided sample by sample as early as possible."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from schemas.trajectories import Phase, Verdict
from tableverse_factory.physics.simulate.at_rest import HOLD_S, SPEED_LIMIT
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS, Goal
from tableverse_factory.robotics.execution.monitor import StateSample
from tableverse_factory.robotics.execution.poses import pose_from_row
from tableverse_factory.robotics.execution.rollout import Rollout, ServoCommands

MIN_LIFT_M = 0.03  # minimum rise at the end of the post-grasp phase that counts as lifted
# Where Y carries X in the end, Y and objects that touch Y may move by this multiple of `max_disturbed_m`: a bowl rocks
# when something is put into it, and its contents make room
CARRIER_FACTOR = 2.0
FALL_M = 0.01  # an object whose center of mass is this far below the table top has fallen from it
DROP_S = 0.06  # an object without finger contact for this long is dropped; single steps without contact are not counted
LAG_RAD = 0.03  # maximum joint error where the fingers close and open, and at the end
BLOCKED_RAD = 0.25  # maximum joint error elsewhere, far above the normal lag of the servos
_PHASES = tuple(Phase)


@dataclass(frozen=True, slots=True)
class RolloutFailure:
    """First failure of a rollout: a reason code, and one line with the values that decided."""

    phase: Phase
    reason: str
    detail: str


def compute_displacement_limits(
    goal: Goal, others: Sequence[str], touching: Sequence[str]
) -> Float64[np.ndarray, " n"]:
    """Compute the allowed displacement of each other object [m]; `touching` initially touch the reference."""
    wide = {goal.y_id, *touching} if goal.relation in RESTING_RELATIONS else set()
    return np.array([goal.max_disturbed_m * (CARRIER_FACTOR if name in wide else 1.0) for name in others])


@dataclass(slots=True)
class SuccessChecker:
    """Online checker of one rollout's samples, in order."""

    goal: Goal
    execution: Rollout
    failure: RolloutFailure | None = None
    at_rest: bool = False  # whether the object was at rest for the last `HOLD_S`
    _allowed_m: np.ndarray = field(init=False)
    _ends: dict[Phase, int] = field(init=False)
    _stood_m: float = 0.0
    _lifted_m: float = 0.0
    _disturbed_m: float = 0.0
    _lost_s: float = 0.0
    _still_s: float = 0.0

    def __post_init__(self) -> None:
        self._ends = {phase: self.execution.commands.last_of(phase) for phase in Phase}
        touching = self.execution.find_touching(self.goal.y_id)
        self._allowed_m = compute_displacement_limits(self.goal, self.execution.others, touching)

    def update(self, sample: StateSample) -> bool:
        """Check the next sample; return whether to continue."""
        if sample.index == 0:
            self._stood_m = float(sample.center[2])
        step_s = self.execution.commands.step_s
        self._lifted_m = max(self._lifted_m, float(sample.center[2]) - self._stood_m)
        self._disturbed_m = max(self._disturbed_m, float(sample.moved_m.max(initial=0.0)))
        self._lost_s = 0.0 if sample.pads else self._lost_s + step_s
        self._still_s = self._still_s + step_s if np.abs(sample.velocity).max() < SPEED_LIMIT else 0.0
        self.at_rest = self._still_s >= HOLD_S - 1e-9
        self.failure = (
            self._check_simulation(sample)
            or self._check_disturbance(sample)
            or self._check_drop(sample)
            or self._check_phase_end(sample)
        )
        return self.failure is None

    def verdict(self, last: StateSample) -> Verdict:
        """Return the final verdict after the last sample."""
        failure = self.failure or self._check_final_state(last)
        figures = {"lifted_m": self._lifted_m, "disturbed_m": self._disturbed_m}
        if failure is None:
            return Verdict(True, "", "", "", **figures)
        return Verdict(False, failure.phase.value, failure.reason, failure.detail, **figures)

    def _check_simulation(self, sample: StateSample) -> RolloutFailure | None:
        if sample.warnings:
            detail = f"MuJoCo warned of {', '.join(sample.warnings)}"
            return RolloutFailure(_PHASES[sample.phase], "simulation_unstable", detail)
        if sample.arm_error_rad > BLOCKED_RAD:
            detail = f"a joint is {sample.arm_error_rad:.3f} rad from its target on the way, more than {BLOCKED_RAD}"
            return RolloutFailure(_PHASES[sample.phase], "servo_lag", detail)
        return None

    def _check_disturbance(self, sample: StateSample) -> RolloutFailure | None:
        if not (sample.moved_m > self._allowed_m).any() and sample.heights_m.min(initial=0.0) >= -FALL_M:
            return None
        if len(fallen := np.flatnonzero(sample.heights_m < -FALL_M)):
            detail = f"{self.execution.others[fallen[0]]} fell from the table"
        else:
            beyond = np.flatnonzero(sample.moved_m > self._allowed_m)
            k = int(beyond[np.argmax(sample.moved_m[beyond])])
            moved, allowed = 1e3 * sample.moved_m[k], 1e3 * self._allowed_m[k]
            detail = f"{self.execution.others[k]} was moved by {moved:.1f} mm, more than {allowed:.1f} mm"
        return RolloutFailure(_PHASES[sample.phase], "disturbed", detail)

    def _check_drop(self, sample: StateSample) -> RolloutFailure | None:
        phase = _PHASES[sample.phase]
        if phase not in (Phase.PRE_PLACE, Phase.PLACE) or self._lost_s < DROP_S - 1e-9:
            return None
        if _is_release_commanded(self.execution.commands, sample.index):
            return None
        rise = 1e3 * (float(sample.center[2]) - self._stood_m)
        detail = f"no finger touched it for {self._lost_s:.2f} s; it was {rise:.0f} mm up"
        return RolloutFailure(phase, "dropped", detail)

    def _check_phase_end(self, sample: StateSample) -> RolloutFailure | None:
        phase = _PHASES[sample.phase]
        if sample.index != self._ends[phase]:
            return None
        if phase in (Phase.GRASP, Phase.PLACE, Phase.POST_PLACE) and sample.arm_error_rad > LAG_RAD:
            detail = f"a joint stands {sample.arm_error_rad:.3f} rad from its target, more than {LAG_RAD}"
            return RolloutFailure(phase, "servo_lag", detail)
        if phase is Phase.GRASP and sample.pads != 3:
            touching = "one finger touches" if sample.pads else "no finger touches"
            return RolloutFailure(phase, "not_grasped", f"{touching} it with the gripper closed")
        rise = float(sample.center[2]) - self._stood_m
        if phase is Phase.POST_GRASP and (rise < MIN_LIFT_M or not sample.pads):
            detail = f"it rose by {1e3 * rise:.1f} mm of at least {1e3 * MIN_LIFT_M:.0f} mm"
            return RolloutFailure(phase, "slipped", detail + ("" if sample.pads else ", and no finger touches it"))
        return None

    def _check_final_state(self, last: StateSample) -> RolloutFailure | None:
        commands, goal = self.execution.commands, self.goal
        reference = last.others[self.execution.others.index(goal.y_id)]
        if (done := _PHASES[last.phase]) is not Phase.POST_PLACE or last.index < len(commands) - 1:
            return RolloutFailure(done, "relation_missed", f"the motion ends in its phase {done.value}")
        if last.pads:
            return RolloutFailure(Phase.POST_PLACE, "not_released", "a finger still touches it in the end")
        if last.center[2] < -FALL_M:
            return RolloutFailure(Phase.PLACE, "relation_missed", f"{goal.x_id} fell from the table")
        if not goal.holds(pose_from_row(last.pose), pose_from_row(reference)):
            x, y, z = 1e3 * last.center
            detail = (
                f"{goal.x_id} is not {goal.relation.value} {goal.y_id}; its centre is at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
            )
            return RolloutFailure(Phase.PLACE, "relation_missed", detail)
        if not self.at_rest:
            fastest = float(np.abs(last.velocity).max())
            detail = f"it moves at {fastest:.3f} m/s or rad/s, and rest is below {SPEED_LIMIT} for {HOLD_S} s"
            return RolloutFailure(Phase.POST_PLACE, "not_at_rest", detail)
        return None


def _is_release_commanded(commands: ServoCommands, index: int) -> bool:
    """Test whether the fingers were commanded to open at the place by this sample."""
    last = min(index, len(commands) - 1)
    start = max(commands.last_of(Phase.PRE_PLACE), 0)
    return bool((np.diff(commands.targets[start : last + 1, -1]) > 1e-6).any())
