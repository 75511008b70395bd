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
    """Candidate grasps of one object as it stands.

    Attributes:
        rotations: Gripper frame in the table frame; the columns are its axes. Shape (n, 3, 3).
        positions: TCP in the table frame. Shape (n, 3) [m].
        widths: Distance between the contacts. Shape (n,) [m].
        scores: Confidence, higher is better. Shape (n,).
    """

    rotations: Float64[np.ndarray, "n 3 3"]
    positions: Points
    widths: Numbers
    scores: Numbers

    def __len__(self) -> int:
        return len(self.scores)

    def select(self, indices: Indices) -> "Grasps":
        """Select grasps, in this order."""
        return Grasps(self.rotations[indices], self.positions[indices], self.widths[indices], self.scores[indices])


@dataclass(frozen=True, slots=True, eq=False)
class Placement(Frozen):
    """Pose at which an object is released.

    Attributes:
        pose: The object's own frame in the table frame, before it is released.
        drop_m: How far it then falls until it touches [m].
        clear_by: How it keeps clear of other objects: `boxes`, or `outlines` seen from above if boxes leave
            no room.
    """

    pose: Pose
    drop_m: float
    clear_by: str = "boxes"


@dataclass(frozen=True, slots=True, eq=False)
class Motion(Frozen):
    """Timed joint motion through the six phases, sampled at a constant step.

    Attributes:
        step_s: Time between samples [s].
        positions: Of the arm's joints. Shape (t, j) [rad].
        velocities: Shape (t, j) [rad/s].
        openings: Commanded distance between the fingers. Shape (t,) [m].
        phases: Index into `Phase` of each sample, ascending. Shape (t,).
        fallbacks: Deviations from the usual plan, in words; usually empty.
    """

    step_s: float
    positions: JointPath
    velocities: JointPath
    openings: Numbers
    phases: Indices
    fallbacks: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.step_s * (len(self.positions) - 1)


@dataclass(frozen=True, slots=True)
class NoMotion:
    """Reason why there is no motion for a grasp and a placement.

    Attributes:
        phase: The first that cannot be planned.
        reason: Code: `out_of_reach`, `blocked`, `no_path`, `no_blend`, `too_fast`, `not_rechecked` or `no_shape`.
        detail: One line for people, with the values that decided.
    """

    phase: Phase
    reason: str
    detail: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a motion's rollout in physics.

    Attributes:
        success: Grasped, lifted, nothing else moved, the relation holds, the object at rest.
        failed_phase: The phase in which it failed; empty if it succeeded.
        reason: Code; empty if it succeeded.
        detail: One line for people, with the values that decided.
        lifted_m: How far the object rose above where it stood [m].
        disturbed_m: Largest displacement of any other object [m].
    """

    success: bool
    failed_phase: str
    reason: str
    detail: str
    lifted_m: float = 0.0
    disturbed_m: float = 0.0
