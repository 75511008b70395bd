"""Arm with a parallel gripper: its MJCF template, joint limits and gripper shape."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points
from schemas.trajectories import JointVector


@dataclass(frozen=True, slots=True, eq=False)
class GripperShape(Frozen):
    """Gripper as boxes along the axes of the gripper frame [m]: origin at the TCP, z approach, y closing axis.

    The boxes of one finger are those of the closed one on the +y side; the other mirrors it in y = 0.
    """

    hand_centers: Points  # what does not move with the fingers
    hand_half_sizes: Points
    finger_centers: Points
    finger_half_sizes: Points
    pad_half_size_xz: Float64[np.ndarray, "2"]  # gripping flat around the TCP

    def boxes(self, opening_m: float) -> tuple[Points, Points]:
        """Return centers and half sizes of all boxes at an opening. Both of shape (h + 2 f, 3) [m]."""
        shift = np.array([0.0, opening_m / 2, 0.0])
        left = self.finger_centers + shift
        centers = np.concatenate([self.hand_centers, left, left * [1.0, -1.0, 1.0]])
        return centers, np.concatenate([self.hand_half_sizes, self.finger_half_sizes, self.finger_half_sizes])


def list_bodies_between(model: mujoco.MjModel, base: int, last: int) -> list[int]:
    """List bodies from the child of a base, or of the world, to a body."""
    bodies: list[int] = []
    while last not in (base, 0):
        bodies.append(last)
        last = int(model.body_parentid[last])
    return bodies[::-1]


@dataclass(frozen=True, slots=True, eq=False)
class Arm(Frozen):
    """Arm on its own, not yet in a scene. Its root body stands upright at the origin."""

    name: str  # as given to `load_arm` and stored in rows and arrays
    template: mujoco.MjSpec  # unattached MJCF; `spec` returns copies
    base_body: str  # the one child of the world body
    joint_names: tuple[str, ...]  # hinges, from the base to the hand
    actuator_names: tuple[str, ...]  # position servo of each joint
    gripper_actuator: str  # its control is affine in the opening
    gripper_control: tuple[float, float]  # closed and open; (0, max_opening_m) where control is the opening
    tcp_site: str  # between the fingertips: z approach, y closing axis
    finger_joints: tuple[str, ...]  # slides or hinges
    finger_open: JointVector  # positions of `finger_joints` [m or rad]
    finger_closed: JointVector
    finger_geoms: tuple[str, ...]  # may touch the gripped object
    home: JointVector  # [rad]
    lower: JointVector  # [rad]
    upper: JointVector  # [rad]
    max_velocity: JointVector  # [rad/s]
    max_acceleration: JointVector  # [rad/s²]
    max_torque: JointVector  # [N m]
    max_opening_m: float  # widest distance between the fingertips
    max_opening_speed: float  # rate of change of that distance [m/s]
    base_radius_m: float  # of the circle around the base's z axis that contains its foot
    shape: GripperShape

    def spec(self) -> mujoco.MjSpec:
        """Return a copy of the MJCF to edit and attach."""
        return self.template.copy()

    def finger_positions(self, opening_m: float) -> JointVector:
        """Return positions of `finger_joints` at an opening. Shape (k,)."""
        share = opening_m / self.max_opening_m
        return self.finger_closed + share * (self.finger_open - self.finger_closed)

    def compute_openings(self, fingers: Float64[np.ndarray, "*t k"]) -> Float64[np.ndarray, "*t"]:
        """Compute the distance between the fingertips from positions of `finger_joints` [m]."""
        span = self.finger_open - self.finger_closed
        return (fingers - self.finger_closed) @ span / (span @ span) * self.max_opening_m

    def gripper_command(self, opening_m: float) -> float:
        """Return the gripper actuator's control for an opening."""
        closed, opened = self.gripper_control
        return closed + opening_m / self.max_opening_m * (opened - closed)
