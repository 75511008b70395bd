"""Arm with a parallel gripper: its MJCF template, joint limits and gripper shape."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points
from schemas.trajectories import JointVector


@dataclass(frozen=True, slots=True, eq=False)
class GripperShape(Frozen):
    """Gripper as boxes along the axes of the gripper frame: origin at the TCP, z approach, y closing axis.

    Attributes:
        hand_centers: Boxes that do not move with the fingers. Shape (h, 3) [m].
        hand_half_sizes: Shape (h, 3) [m].
        finger_centers: Boxes of the closed finger on the +y side; the other finger mirrors it in y = 0. Shape (f, 3)
            [m].
        finger_half_sizes: Shape (f, 3) [m].
        pad_half_size_xz: Gripping flat around the TCP, along x and z of the gripper frame. Shape (2,) [m].
    """

    hand_centers: Points
    hand_half_sizes: Points
    finger_centers: Points
    finger_half_sizes: Points
    pad_half_size_xz: Float64[np.ndarray, "2"]

    def boxes(self, opening_m: float) -> tuple[Points, Points]:
        """Return centers and half sizes of all boxes at an opening. Both of shape (h + 2 f, 3) [m]."""
        shift = np.array([0.0, opening_m / 2, 0.0])
        left = self.finger_centers + shift
        centers = np.concatenate([self.hand_centers, left, left * [1.0, -1.0, 1.0]])
        return centers, np.concatenate([self.hand_half_sizes, self.finger_half_sizes, self.finger_half_sizes])


@dataclass(frozen=True, slots=True, eq=False)
class Arm(Frozen):
    """Arm on its own, not yet in a scene. Its root body stands upright at the origin.

    Attributes:
        name: As given to `load_arm` and stored in rows and arrays.
        template: Unattached MJCF; `spec` returns copies.
        base_body: The one child of the world body.
        joint_names: The arm's hinges, from the base to the hand.
        actuator_names: Position servo of each joint.
        gripper_actuator: Actuator whose control is affine in the opening.
        gripper_control: Control with closed and with open fingers; (0, max_opening_m) where control is the opening.
        tcp_site: Site between the fingertips: z approach, y closing axis.
        finger_joints: Slides or hinges of the fingers.
        finger_open: Positions of `finger_joints` with open fingers. Shape (k,) [m or rad].
        finger_closed: Positions with closed fingers. Shape (k,).
        finger_geoms: Geoms that may touch the gripped object.
        home: Shape (j,) [rad].
        lower: Joint limits. Shape (j,) [rad].
        upper: Shape (j,) [rad].
        max_velocity: Shape (j,) [rad/s].
        max_acceleration: Shape (j,) [rad/s²].
        max_torque: Shape (j,) [N m].
        max_opening_m: Widest distance between the fingertips [m].
        max_opening_speed: Rate of change of that distance [m/s].
        base_radius_m: Radius of the circle around the base's z axis that contains its foot [m].
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
        """Return a copy of the MJCF to edit and attach."""
        return self.template.copy()

    def finger_positions(self, opening_m: float) -> JointVector:
        """Return positions of `finger_joints` at an opening. Shape (k,)."""
        share = opening_m / self.max_opening_m
        return self.finger_closed + share * (self.finger_open - self.finger_closed)

    def gripper_command(self, opening_m: float) -> float:
        """Return the gripper actuator's control for an opening."""
        closed, opened = self.gripper_control
        return closed + opening_m / self.max_opening_m * (opened - closed)
