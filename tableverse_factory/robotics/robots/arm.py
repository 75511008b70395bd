"""An arm with a parallel gripper: its MJCF, what its joints may do, and the shape of its gripper."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points
from schemas.trajectories import JointVector


@dataclass(frozen=True, slots=True, eq=False)
class GripperShape(Frozen):
    """The gripper as boxes along the axes of the gripper frame: origin at the TCP, z approach, y closing axis.

    Attributes:
        hand_centers: Of the boxes that do not move with the fingers. Shape (h, 3) [m].
        hand_half_sizes: Shape (h, 3) [m].
        finger_centers: Of the boxes of the finger on the +y side where it is closed; the other finger is its mirror
            image in y = 0. Shape (f, 3) [m].
        finger_half_sizes: Shape (f, 3) [m].
        pad_half_size_xz: Of the flat that grips, around the TCP, along x and z of the gripper frame. Shape (2,) [m].
    """

    hand_centers: Points
    hand_half_sizes: Points
    finger_centers: Points
    finger_half_sizes: Points
    pad_half_size_xz: Float64[np.ndarray, "2"]

    def boxes(self, opening_m: float) -> tuple[Points, Points]:
        """Centres and half sizes of all boxes with the fingers this far apart. Both of shape (h + 2 f, 3) [m]."""
        shift = np.array([0.0, opening_m / 2, 0.0])
        left = self.finger_centers + shift
        centers = np.concatenate([self.hand_centers, left, left * [1.0, -1.0, 1.0]])
        return centers, np.concatenate([self.hand_half_sizes, self.finger_half_sizes, self.finger_half_sizes])


@dataclass(frozen=True, slots=True, eq=False)
class Arm(Frozen):
    """An arm on its own, not yet in any scene. Its root body stands at the origin, upright.

    Attributes:
        name: As it was asked for (`doors.arm_of`), and as it stands in rows and arrays.
        template: Its MJCF, unattached; `spec` gives copies of it.
        base_body: Name of the one body of the world that carries all.
        joint_names: Of the arm's hinges, from the base to the hand.
        actuator_names: Position servo of each of these joints.
        gripper_actuator: Its control is affine in the opening (`gripper_control`).
        gripper_control: Control with closed and with open fingers; (0, max_opening_m) where control is the opening.
        tcp_site: Site between the fingertips: z approach, y closing axis.
        finger_joints: Slides or hinges of the fingers.
        finger_open: Positions of `finger_joints` with open fingers. Shape (k,) [m or rad].
        finger_closed: The same with closed ones. Shape (k,).
        finger_geoms: Geoms that may touch what is gripped.
        home: Shape (j,) [rad].
        lower: Limits of the joints. Shape (j,) [rad].
        upper: Shape (j,) [rad].
        max_velocity: Shape (j,) [rad/s].
        max_acceleration: Shape (j,) [rad/s²].
        max_torque: Shape (j,) [N m].
        max_opening_m: Widest distance between the fingertips [m].
        max_opening_speed: Of the distance between the fingertips [m/s].
        base_radius_m: Of a circle around the base's z axis that its foot stands in [m].
        shape: Of the gripper.
    """

    name: str
    template: mujoco.MjSpec
    base_body: str
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...]
    gripper_actuator: str
    gripper_control: tuple[float, float]
    tcp_site: str
    finger_joints: tuple[str, ...]
    finger_open: JointVector
    finger_closed: JointVector
    finger_geoms: tuple[str, ...]
    home: JointVector
    lower: JointVector
    upper: JointVector
    max_velocity: JointVector
    max_acceleration: JointVector
    max_torque: JointVector
    max_opening_m: float
    max_opening_speed: float
    base_radius_m: float
    shape: GripperShape

    def spec(self) -> mujoco.MjSpec:
        """The arm as a specification of its own, to edit and attach."""
        return self.template.copy()

    def finger_positions(self, opening_m: float) -> JointVector:
        """Positions of `finger_joints` at this opening. Shape (k,)."""
        share = opening_m / self.max_opening_m
        positions: JointVector = self.finger_closed + share * (self.finger_open - self.finger_closed)
        return positions

    def gripper_command(self, opening_m: float) -> float:
        """The gripper actuator's control for this opening."""
        closed, opened = self.gripper_control
        return closed + opening_m / self.max_opening_m * (opened - closed)
