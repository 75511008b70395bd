"""Measurements of a station during execution, once per sample."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64, Int32

from schemas.geometry import Vector3
from tableverse_factory.physics.simulate.at_rest import list_warnings
from tableverse_factory.robotics.robots.station import Station


@dataclass(slots=True, eq=False)
class StateSample:
    """State in which the targets have just reached a sample's command; mutable for speed."""

    index: int  # counts on while the last command is repeated
    phase: int  # index into `Phase`
    command: Float64[np.ndarray, " k"]  # targets of the joints [rad] and the opening [m]
    qpos: Float64[np.ndarray, " m"]  # joints [rad] and fingers [m]
    qvel: Float64[np.ndarray, " m"]  # their speeds
    tcp: Float64[np.ndarray, "7"]  # gripper frame in the table frame: position [m], quaternion wxyz
    pose: Float64[np.ndarray, "7"]  # the carried object's own frame, likewise
    others: Float64[np.ndarray, "n 7"]  # of each other object, in the order of `Rollout.others`
    center: Vector3  # of mass of the carried object [m]
    velocity: Float64[np.ndarray, "6"]  # of its frame [m/s], then its spin [rad/s]
    pads: int  # fingers that touch the object: 1 the first, 2 the second, 3 both
    moved_m: Float64[np.ndarray, " n"]  # displacement of each other object
    heights_m: Float64[np.ndarray, " n"]  # of their centers of mass
    arm_error_rad: float  # largest distance of a joint from its target
    warnings: tuple[str, ...]  # MuJoCo warnings that invalidate the simulation


class ExecutionMonitor:
    """Monitor of a carried object, all others (`others`, in the order of the model), and the arm; `begin` it first."""

    def __init__(self, station: Station, x_id: str) -> None:
        self.others = tuple(name for name in station.object_ids if name != x_id)
        self._station, self._model = station, station.model
        self._body = station.object_bodies[x_id]
        self._pose, self._velocity = station.object_qpos[x_id], station.object_dof[x_id]
        self._qpos = np.concatenate([station.joint_qpos, station.finger_qpos])
        self._qvel = np.concatenate([station.joint_dof, station.finger_dof])
        self._other_poses = np.array([station.object_qpos[name] for name in self.others], dtype=np.intp)[:, None]
        self._other_bodies = np.array([station.object_bodies[name] for name in self.others], dtype=np.intp)
        self._finger_of, self._bodies = _label_finger_geoms(station), np.array(station.model.geom_bodyid)

    def begin(self, data: mujoco.MjData) -> None:
        """Store the reference state for displacements; positions in `data` must be computed."""
        self._start = (data.xipos[self._other_bodies].copy(), data.ximat[self._other_bodies].copy())
        inertia, mass = self._model.body_inertia[self._other_bodies], self._model.body_mass[self._other_bodies]
        # Mean square distance of each other body's matter from its center, along principal axes [m²]. Shape (n, 3)
        self._spread = (inertia.sum(axis=1, keepdims=True) / 2 - inertia) / mass[:, None]

    def find_touching(self, data: mujoco.MjData, object_id: str) -> tuple[str, ...]:
        """Find the uncarried objects that touch another object now."""
        near = {frozenset(pair) for pair in self._bodies[data.contact.geom].tolist()}
        own = self._station.object_bodies[object_id]
        return tuple(name for name in self.others if frozenset((own, self._station.object_bodies[name])) in near)

    def sample(self, data: mujoco.MjData, index: int, phase: int, command: Float64[np.ndarray, " k"]) -> StateSample:
        """Measure the state after a step; positions are recomputed."""
        pads = self._list_touching_fingers(data)  # of the last step; what follows is where that step has led
        mujoco.mj_kinematics(self._model, data)
        centers, axes = data.xipos[self._other_bodies], data.ximat[self._other_bodies]
        turned = ((axes - self._start[1]).reshape(-1, 3, 3) ** 2).sum(axis=1)
        moved = np.sqrt(((centers - self._start[0]) ** 2).sum(axis=1) + (turned * self._spread).sum(axis=1))
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[self._station.tcp_site])
        return StateSample(
            index=index,
            phase=phase,
            command=command,
            qpos=data.qpos[self._qpos],
            qvel=data.qvel[self._qvel],
            tcp=np.concatenate([data.site_xpos[self._station.tcp_site], quaternion]),
            pose=data.qpos[self._pose : self._pose + 7].copy(),
            others=data.qpos[self._other_poses + np.arange(7)],
            center=data.xipos[self._body].copy(),
            velocity=data.qvel[self._velocity : self._velocity + 6].copy(),
            pads=pads,
            moved_m=moved,
            heights_m=centers[:, 2],
            arm_error_rad=float(np.abs(data.qpos[self._station.joint_qpos] - command[:-1]).max()),
            warnings=list_warnings(data),
        )

    def _list_touching_fingers(self, data: mujoco.MjData) -> int:
        pairs = data.contact.geom
        fingers = self._finger_of[pairs]  # 0 where a geom is none of a finger
        mine = self._bodies[pairs[:, ::-1]] == self._body
        return int(np.bitwise_or.reduce(fingers[mine], initial=0))


def _label_finger_geoms(station: Station) -> Int32[np.ndarray, " g"]:
    """Label geoms that grip 1 or 2 for the first or second finger, others 0."""
    finger = np.zeros(station.model.ngeom, dtype=np.int32)
    bodies = station.model.geom_bodyid[station.finger_geoms]
    finger[station.finger_geoms] = np.where(bodies == bodies.min(), 1, 2)
    return finger
