"""Forward simulation until rest is measured, and the drift after it."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.geometry import Frozen, Pose
from tableverse_factory.geometry.math.transforms import normalized_quaternion, rotation_angle
from tableverse_factory.physics.simulate.mujoco_sleep import sleeping

SPEED_LIMIT = 0.01
"""At rest every object moves slower than this, in m/s and in rad/s."""

ACCELERATION_LIMIT = 0.5
"""And changes its speed by less than this, in m/s² and in rad/s², from one look to the next."""

HOLD_S = 0.2
"""For so long without a break."""

GENTLE_S = 0.4
GENTLE_RATE = 40.0
"""While settling gently, speed decays with this rate [1/s]: a free fall ends at 0.25 m/s."""

STEPS_BETWEEN_LOOKS = 5
STEPS_BETWEEN_YAWNS = 25
"""How often it is asked whether all is asleep."""

NUDGES = 1e-6 * np.array([[1.0, 1, 1, 1, 1, 1], [1, -1, 1, 1, -1, 1]])
"""Velocities that every body is given before its drift is measured, and again `NUDGE_APART_S` later [m/s, rad/s].

Friction stops them within a step or two, but what stands on its tip or edge falls, and without them would stand for as
long as rounding errors take. No direction across the table is at right angles to both.
"""

NUDGE_APART_S = 0.1
"""Until then nothing sleeps."""

DRIFT_SLEEP_TOLERANCE = 1e-9
"""What sleeps below it would have moved by 5 nm in the certificate's 5 s; most of what settled stands at 1e-15."""

UNSTABLE = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_INERTIA,
    mujoco.mjtWarning.mjWARN_CONTACTFULL,
    mujoco.mjtWarning.mjWARN_CNSTRFULL,
)


@dataclass(frozen=True, slots=True, eq=False)
class Rest(Frozen):
    """How a simulation ended.

    Attributes:
        at_rest: Whether rest was measured within the time.
        time_s: Simulated time [s].
        poses: Pose of each free body at the end, in the order of the model.
        speeds: Largest |qvel| component of each body within the last `HOLD_S` [m/s or rad/s].
        moving: Which bodies were faster, or changed their speed faster, than rest allows within that time.
        warnings: Names of MuJoCo's warnings that make the result worthless; empty when all is well.
    """

    at_rest: bool
    time_s: float
    poses: tuple[Pose, ...]
    speeds: Float64[np.ndarray, " n"]
    moving: Bool[np.ndarray, " n"]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Drift(Frozen):
    """Motion of each body over some further time.

    Attributes:
        distance_m: Displacement of each body's centre of mass [m].
        sunk_m: How far each centre of mass went down [m]; negative where it rose.
        angle_rad: Rotation of each body [rad].
        poses: Where they are at the end.
        warnings: As in `Rest`.
    """

    distance_m: Float64[np.ndarray, " n"]
    sunk_m: Float64[np.ndarray, " n"]
    angle_rad: Float64[np.ndarray, " n"]
    poses: tuple[Pose, ...]
    warnings: tuple[str, ...]


def free_bodies(model: mujoco.MjModel) -> list[int]:
    """Ids of the bodies with a free joint, in the order of the model."""
    return [int(model.jnt_bodyid[j]) for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]


def simulate_to_rest(
    model: mujoco.MjModel, max_time_s: float, gentle: bool = True, lost_below_m: float = -np.inf
) -> Rest:
    """Steps the model from its initial state until all free bodies are at rest, or `max_time_s` has passed.

    Args:
        model: Its free bodies are looked at, in its order.
        max_time_s: Bound on simulated time [s].
        gentle: First let everything sink like in honey, so that small gaps close without a kick; then freely.
        lost_below_m: Once the centre of mass of a body is lower than this, the simulation ends before its time [m].
    """
    data = quiet_data(model)
    bodies = free_bodies(model)
    dofs = _dofs(model, bodies)
    if gentle:
        _sink(model, data, min(GENTLE_S, max_time_s))
    velocity = data.qvel[dofs]
    speeds = deque([_largest(velocity)], maxlen=_looks(model))
    moving = deque([np.ones(len(bodies), dtype=bool)], maxlen=_looks(model))
    held_since, resting, lost = data.time, False, False
    while data.time < max_time_s and not (resting or lost or _warnings(data)):
        mujoco.mj_step(model, data, nstep=STEPS_BETWEEN_LOOKS)
        before, velocity = velocity, data.qvel[dofs]
        speeds.append(_largest(velocity))
        accelerations = _largest(velocity - before) / (STEPS_BETWEEN_LOOKS * model.opt.timestep)
        moving.append(~((speeds[-1] < SPEED_LIMIT) & (accelerations < ACCELERATION_LIMIT)))
        if moving[-1].any():
            held_since = data.time
        resting = data.time - held_since >= HOLD_S
        lost = bool((data.xipos[bodies, 2] < lost_below_m).any())
    poses = body_poses(model, data, bodies)
    return Rest(resting, float(data.time), poses, np.max(speeds, axis=0), np.any(moving, axis=0), _warnings(data))


def measure_drift(model: mujoco.MjModel, duration_s: float) -> Drift:
    """Steps the model for `duration_s` from its initial state, nudging every free body, and compares the end with it.

    What has come to rest sleeps meanwhile, which is most of the time of a scene that keeps still.
    """
    data = quiet_data(model)
    mujoco.mj_kinematics(model, data)
    bodies = free_bodies(model)
    start_centers, start = data.xipos[bodies].copy(), body_poses(model, data, bodies)
    dofs = _dofs(model, bodies)
    steps, awake = (round(seconds / model.opt.timestep) for seconds in (duration_s, min(NUDGE_APART_S, duration_s)))
    data.qvel[dofs] += NUDGES[0]
    mujoco.mj_step(model, data, nstep=awake)
    data.qvel[dofs] += NUDGES[1]
    with sleeping(model, DRIFT_SLEEP_TOLERANCE):
        for done in range(awake, steps, STEPS_BETWEEN_YAWNS):
            mujoco.mj_step(model, data, nstep=min(STEPS_BETWEEN_YAWNS, steps - done))
            if (data.tree_asleep >= 0).all():
                break  # nothing wakes what sleeps but what does not
    mujoco.mj_kinematics(model, data)
    end = body_poses(model, data, bodies)
    angles = [rotation_angle(a.quaternion_wxyz, b.quaternion_wxyz) for a, b in zip(start, end, strict=True)]
    moved = data.xipos[bodies] - start_centers
    return Drift(np.linalg.norm(moved, axis=1), -moved[:, 2], np.array(angles), end, _warnings(data))


def body_poses(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int]) -> tuple[Pose, ...]:
    """Poses of free bodies, from the generalised positions."""
    starts = [_position_address(model, body) for body in bodies]
    return tuple(
        Pose(data.qpos[s : s + 3].copy(), normalized_quaternion(data.qpos[s + 3 : s + 7].copy())) for s in starts
    )


def set_poses(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int], poses: Sequence[Pose]) -> None:
    """Puts free bodies at poses; everything else stays."""
    for body, pose in zip(bodies, poses, strict=True):
        start = _position_address(model, body)
        data.qpos[start : start + 3] = pose.position
        data.qpos[start + 3 : start + 7] = pose.quaternion_wxyz


def quiet_data(model: mujoco.MjModel) -> mujoco.MjData:
    """Data for a simulation whose warnings are read from it, instead of MuJoCo's log file in the current folder."""
    mujoco.set_mju_user_warning(_ignore)
    return mujoco.MjData(model)


def _ignore(message: str) -> None:
    """Takes a warning that `_warnings` counts."""


def _dofs(model: mujoco.MjModel, bodies: Sequence[int]) -> Int64[np.ndarray, "n 6"]:
    """Indices of the velocities of free bodies."""
    first = np.array([int(model.body_dofadr[body]) for body in bodies], dtype=np.int64)
    dofs: Int64[np.ndarray, "n 6"] = first[:, None] + np.arange(6)
    return dofs


def _position_address(model: mujoco.MjModel, body: int) -> int:
    return int(model.jnt_qposadr[model.body_jntadr[body]])


def _largest(velocity: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, " n"]:
    """The largest component of each body."""
    largest: Float64[np.ndarray, " n"] = np.abs(velocity).max(axis=1, initial=0.0)
    return largest


def _looks(model: mujoco.MjModel) -> int:
    """How often the speeds are looked at within `HOLD_S`."""
    return max(1, round(HOLD_S / (STEPS_BETWEEN_LOOKS * float(model.opt.timestep))))


def _sink(model: mujoco.MjModel, data: mujoco.MjData, duration_s: float) -> None:
    decay = float(np.exp(-GENTLE_RATE * model.opt.timestep))
    while data.time < duration_s and not _warnings(data):
        mujoco.mj_step(model, data)
        data.qvel *= decay


def _warnings(data: mujoco.MjData) -> tuple[str, ...]:
    return tuple(kind.name.removeprefix("mjWARN_").lower() for kind in UNSTABLE if data.warning[kind].number)
