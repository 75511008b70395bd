"""Grasps, placements, timed joint motions and verdicts of tasks.

Frames: everything stands in the table frame unless a name says otherwise. The gripper's own frame has its origin
between the fingertips (TCP), z along the approach, y along the closing axis.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int32

from schemas.geometry import Frozen, Points, Pose

Numbers = Float64[np.ndarray, "n"]
Indices = Int32[np.ndarray, "n"]
JointVector = Float64[np.ndarray, "j"]
JointPath = Float64[np.ndarray, "t j"]


class Phase(StrEnum):
    """The six phases of a pick and place, in order; each is named after the pose in which it ends."""

    PRE_GRASP = "pre_grasp"
    GRASP = "grasp"
    POST_GRASP = "post_grasp"
    PRE_PLACE = "pre_place"
    PLACE = "place"
    POST_PLACE = "post_place"


@dataclass(frozen=True, slots=True, eq=False)
class Grasps(Frozen):
    """Candidate grasps of one object as it stands."""

    rotations: Float64[np.ndarray, "n 3 3"]  # gripper frame in the table frame; the columns are its axes
    positions: Points  # TCP in the table frame, shape (n, 3) [m]
    widths: Numbers  # distance between the contacts, shape (n,) [m]
    scores: Numbers  # confidence, higher is better, shape (n,)

    def __len__(self) -> int:
        return len(self.scores)

    def select(self, indices: Indices) -> "Grasps":
        """Select grasps, in this order."""
        return Grasps(self.rotations[indices], self.positions[indices], self.widths[indices], self.scores[indices])


@dataclass(frozen=True, slots=True, eq=False)
class Placement(Frozen):
    """Pose at which an object is released."""

    pose: Pose  # the object's own frame in the table frame, before it is released
    drop_m: float  # how far it then falls until it touches [m]
    clear_by: str = "boxes"  # keeps clear of other objects by `boxes`, or `outlines` seen from above in narrow places


@dataclass(frozen=True, slots=True, eq=False)
class Motion(Frozen):
    """Timed joint motion through the six phases, sampled at a constant step."""

    step_s: float  # time between samples [s]
    positions: JointPath  # of the arm's joints, shape (t, j) [rad]
    velocities: JointPath  # shape (t, j) [rad/s]
    openings: Numbers  # commanded distance between the fingers, shape (t,) [m]
    phases: Indices  # index into `Phase` of each sample, ascending, shape (t,)
    fallbacks: tuple[str, ...] = ()  # deviations from the usual plan, in words; usually empty

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.step_s * (len(self.positions) - 1)


@dataclass(frozen=True, slots=True)
class NoMotion:
    """Reason why there is no motion for a grasp and a placement."""

    phase: Phase  # the first that cannot be planned
    reason: str  # `out_of_reach`, `blocked`, `no_path`, `no_blend`, `too_fast`, `not_rechecked` or `no_shape`
    detail: str  # one line for people, with the values that decided


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a motion's rollout in physics."""

    success: bool  # grasped, lifted, nothing else moved, the relation holds, the object at rest
    failed_phase: str  # the phase in which it failed; empty if it succeeded
    reason: str  # code; empty if it succeeded
    detail: str  # one line for people, with the values that decided
    lifted_m: float = 0.0  # how far the object rose above where it stood [m]
    disturbed_m: float = 0.0  # largest displacement of any other object [m]
