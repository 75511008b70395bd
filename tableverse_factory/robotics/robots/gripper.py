"""Parallel gripper measured on its model: how its control moves the fingers, and boxes around its geoms."""

from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Frozen, Points
from schemas.trajectories import JointVector
from tableverse_factory.core.errors import InputError
from tableverse_factory.physics.mjcf.geom_meshes import make_geom_mesh
from tableverse_factory.physics.simulate.at_rest import make_quiet_data
from tableverse_factory.robotics.robots.arm import GripperShape

SETTLE_S = 3.0
REST_SPEED_M_S = 1e-3  # fingers that are faster after `SETTLE_S` do not come to rest under their actuator
MAX_CLOSED_GAP_M = 0.005  # maximum gap between closed fingertips, so that travel equals opening
_STEP_S = 0.002
_MAX_SKEW_M, _MIN_OPENING_M = 0.001, 0.01
_DIGITS = 7  # decimals kept of simulated rest positions; the rest is within the simulation's tolerance


@dataclass(frozen=True, slots=True, eq=False)
class Gripper(Frozen):
    """Two fingers that slide towards each other."""

    joints: tuple[int, ...]  # ids of the finger slides
    geoms: tuple[int, ...]  # ids of the colliding finger geoms
    control: tuple[float, float]  # of the actuator with closed and with open fingers
    closed: JointVector  # joint positions [m]
    opened: JointVector  # joint positions [m]
    max_opening_m: float  # between the open fingertips
    shape: GripperShape


def measure_gripper(
    model: mujoco.MjModel, site: int, arm_joints: list[int], actuator: int, home: JointVector
) -> Gripper:
    """Drive the gripper's actuator to both ends of its range, without gravity and contact, and measure the fingers.

    `site` is the TCP's id; `home` holds all positions to start from. Shape (nq,).
    """
    joints = [joint for joint in range(model.njnt) if joint not in arm_joints]
    if len(joints) != 2 or (model.jnt_type[joints] != mujoco.mjtJoint.mjJNT_SLIDE).any():
        raise robot_error(f"the gripper has {len(joints)} joints: only two fingers that slide are known here")
    bodies, reach = [int(model.jnt_bodyid[joint]) for joint in joints], model.actuator_ctrlrange[actuator]
    ends = [(end, _drive_fingers(model, joints, actuator, end, home)) for end in map(float, reach)]
    ends.sort(key=lambda end: float(np.linalg.norm(end[1].xpos[bodies[0]] - end[1].xpos[bodies[1]])))
    (shut, closed), (wide, opened) = ends
    travel = _to_gripper_frame(opened, site, opened.xpos[bodies]) - _to_gripper_frame(closed, site, closed.xpos[bodies])
    _check_travel(travel)
    fingers = [_find_contact_geoms(model, body) for body in bodies]
    _check_meet(model, closed, fingers)
    left = 0 if travel[0, 1] > 0.0 else 1
    return Gripper(
        joints=tuple(joints),
        geoms=(*fingers[0], *fingers[1]),
        control=(shut, wide),
        closed=np.round(closed.qpos[model.jnt_qposadr[joints]], _DIGITS),
        opened=np.round(opened.qpos[model.jnt_qposadr[joints]], _DIGITS),
        max_opening_m=round(float(np.abs(travel[:, 1]).sum()), _DIGITS),
        shape=_measure_shape(model, closed, site, fingers[left], bodies[left]),
    )


def _drive_fingers(
    model: mujoco.MjModel, joints: list[int], actuator: int, control: float, home: JointVector
) -> mujoco.MjData:
    """Simulate until the fingers rest, then put the arm back home before positions are read."""
    flags = int(model.opt.disableflags)
    model.opt.disableflags = flags | int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    # As in a scene, whatever the file says: its own step might be a nanosecond.
    model.opt.timestep, model.opt.integrator = _STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = make_quiet_data(model)
    data.qpos[:] = home
    for other in range(model.nu):
        joint = int(model.actuator_trnid[other, 0])
        data.ctrl[other] = control if other == actuator else home[model.jnt_qposadr[joint]]
    mujoco.mj_step(model, data, nstep=round(SETTLE_S / _STEP_S))
    model.opt.disableflags = flags
    speed = float(np.abs(data.qvel[model.jnt_dofadr[joints]]).max())
    if not speed < REST_SPEED_M_S:
        raise robot_error(
            f"the fingers still move at {speed:.3g} m/s after {SETTLE_S:g} s under the gripper's actuator"
        )
    fingers = np.array(data.qpos[model.jnt_qposadr[joints]])
    data.qpos[:] = home
    data.qpos[model.jnt_qposadr[joints]] = fingers
    mujoco.mj_kinematics(model, data)
    return data


def _check_travel(travel: Points) -> None:
    along, total = np.abs(travel[:, 1]), np.linalg.norm(travel, axis=1)
    if along.sum() < _MIN_OPENING_M:
        moved = along.round(4).tolist()
        raise robot_error(f"the gripper's actuator moves the fingers by {moved} m along the TCP's y axis")
    if (total - along).max() > _MAX_SKEW_M or abs(travel[:, 1].sum()) > _MAX_SKEW_M:
        raise robot_error(
            f"the fingers move by {travel.round(4).tolist()} m in the TCP's frame: they must slide evenly along its y"
        )


def _check_meet(model: mujoco.MjModel, closed: mujoco.MjData, fingers: list[list[int]]) -> None:
    if not (fingers[0] and fingers[1]):
        raise robot_error("a finger has no geom that touches anything")
    gap = min(mujoco.mj_geomDistance(model, closed, a, b, 1.0, None) for a in fingers[0] for b in fingers[1])
    if gap > MAX_CLOSED_GAP_M:
        raise robot_error(f"closed, the fingers are {gap:.4f} m apart: they must meet, within {MAX_CLOSED_GAP_M:g} m")


def _find_contact_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """Find colliding geoms of a body and of everything fixed to it."""
    return [
        geom
        for geom in range(model.ngeom)
        if model.body_weldid[model.geom_bodyid[geom]] == model.body_weldid[body]
        and (model.geom_contype[geom] or model.geom_conaffinity[geom])
    ]


def _measure_shape(
    model: mujoco.MjModel, closed: mujoco.MjData, site: int, finger: list[int], body: int
) -> GripperShape:
    """Fit boxes around the hand that carries the fingers and around one finger."""
    hand = _find_contact_geoms(model, int(model.body_parentid[body]))
    hand_boxes = [_measure_box(model, closed, site, geom) for geom in hand]
    finger_boxes = [_measure_box(model, closed, site, geom) for geom in finger]
    around = [
        (center, half) for center, half in finger_boxes if (np.abs(center) <= half + MAX_CLOSED_GAP_M)[[0, 2]].all()
    ]
    if not around:
        raise robot_error("no geom of the fingers lies at the site 'tcp': put it between the fingertips")
    pad = min(around, key=lambda box: float(np.prod(box[1])))
    return GripperShape(
        hand_centers=np.reshape([center for center, _ in hand_boxes], (-1, 3)),
        hand_half_sizes=np.reshape([half for _, half in hand_boxes], (-1, 3)),
        finger_centers=np.array([center for center, _ in finger_boxes]),
        finger_half_sizes=np.array([half for _, half in finger_boxes]),
        pad_half_size_xz=np.maximum(pad[1] - np.abs(pad[0]), 1e-3)[[0, 2]],
    )


def _measure_box(model: mujoco.MjModel, data: mujoco.MjData, site: int, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute center and half size of the box around a geom, along the gripper frame's axes [m]."""
    shape = make_geom_mesh(model, geom)
    if shape is None:
        name = model.geom(geom).name
        raise robot_error(f"the geom {name!r} of the gripper is of a kind that has no shape of its own")
    points = _to_gripper_frame(data, site, shape.vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, (high - low) / 2


def _to_gripper_frame(data: mujoco.MjData, site: int, points: Points) -> Points:
    """Transform world points into the gripper frame. Shape (n, 3) [m]."""
    return (points - data.site_xpos[site]) @ data.site_xmat[site].reshape(3, 3)


def robot_error(message: str) -> InputError:
    """Build the error for an MJCF that is not a usable arm."""
    return InputError(message, "bad_robot")
