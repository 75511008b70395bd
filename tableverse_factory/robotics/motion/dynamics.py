"""Inverse dynamics of an arm with its payload, by MuJoCo on the arm alone."""

from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import JointVector
from tableverse_factory.geometry.math.transforms import compose_poses
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.station import Station

_PAYLOAD = "load"
_FREE = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT


@dataclass(frozen=True, slots=True, eq=False)
class CarriedObject(Frozen):
    """Object between the fingers that follows the TCP, by its own frame in the gripper frame."""

    object_id: str
    object_to_tcp: Pose


class ArmDynamics:
    """Arm on an upright base, with or without a payload.

    The arm's weight counts, although the simulation compensates it: a real arm's drives have to hold it.
    """

    def __init__(self, arm: Arm) -> None:
        spec = arm.spec()
        spec.option.disableflags |= _FREE
        site = spec.site(arm.tcp_site)
        load = site.parent.add_body(name=_PAYLOAD, pos=site.pos, quat=site.quat)
        load.mass, load.inertia, load.explicitinertial = 1e-6, [1e-9, 1e-9, 1e-9], True
        self._model = spec.compile()
        self._model.body_gravcomp[:] = 0.0
        self._data = mujoco.MjData(self._model)
        self._load = int(self._model.body(_PAYLOAD).id)
        self._empty = (1e-6, np.zeros(3), np.full(3, 1e-9), np.array([1.0, 0.0, 0.0, 0.0]))
        joints = [self._model.joint(name).id for name in arm.joint_names]
        self._qpos, self._dof = self._model.jnt_qposadr[joints], self._model.jnt_dofadr[joints]

    def set_payload(self, station: Station, carried: CarriedObject | None) -> None:
        """Put an object of the station between the fingers, or nothing."""
        model, body = self._model, self._load
        mass, center, inertia, axes = self._empty
        if carried is not None:
            source, held = station.model, station.object_bodies[carried.object_id]
            mass, inertia = float(source.body_mass[held]), source.body_inertia[held]
            principal = Pose(np.array(source.body_ipos[held]), np.array(source.body_iquat[held]))
            placed = compose_poses(carried.object_to_tcp, principal)
            center, axes = placed.position, placed.quaternion_wxyz
        model.body_mass[body], model.body_ipos[body] = mass, center
        model.body_inertia[body], model.body_iquat[body] = inertia, axes
        mujoco.mj_setConst(model, self._data)

    def compute_torques(self, q: JointVector, velocity: JointVector, acceleration: JointVector) -> JointVector:
        """Compute the drives' torques [N m] from positions, velocities and accelerations [rad, rad/s, rad/s²]."""
        data = self._data
        data.qpos[self._qpos], data.qvel[self._dof], data.qacc[self._dof] = q, velocity, acceleration
        mujoco.mj_inverse(self._model, data)
        return data.qfrc_inverse[self._dof].copy()
