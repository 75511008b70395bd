"""Simulation until all bodies are at rest, and their drift afterwards."""

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.geometry import Frozen, Pose
from tableverse_factory.geometry.math.transforms import normalize_quaternion, rotation_angle

SPEED_LIMIT = 0.01  # at rest every object moves slower than this, in m/s and in rad/s
ACCELERATION_LIMIT = 0.5  # and changes its speed by less than this between samples, in m/s² and in rad/s²
HOLD_S = 0.2  # time for which this must hold without a break [s]
GENTLE_S = 0.4
GENTLE_RATE = 40.0  # while settling gently, speed decays with this rate [1/s]: a free fall ends at 0.25 m/s
STEPS_PER_SAMPLE = 5
STEPS_PER_SLEEP_CHECK = 25  # steps between checks whether all bodies sleep

# Velocities that every body is given before its drift is measured, and again `NUDGE_INTERVAL_S` later [m/s, rad/s].
# Friction stops them within a step or two, but a body on its tip or edge falls, which would depend on rounding errors
# otherwise. No direction across the table is at right angles to both.
NUDGES = 1e-6 * np.array([[1.0, 1, 1, 1, 1, 1], [1, -1, 1, 1, -1, 1]])
NUDGE_INTERVAL_S = 0.1
# Sleeping bodies would move by 5 µm in the certificate's 5 s. What falls off its tip is faster when sleep is allowed;
# what a nudge holds up for so long, such as a ball that it sends up a slope, accelerates by 2 µm/s² at most: 20 µm.
DRIFT_SLEEP_TOLERANCE, SLEEP_AFTER_S = 1e-6, 0.5
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
    """Outcome of a simulation, with the free bodies in the order of the model.

    Attributes:
        speeds: Largest |qvel| component of each body within the last `HOLD_S` [m/s or rad/s].
        moving: Which bodies were faster, or changed their speed faster, than rest allows within that time.
        warnings: Names of MuJoCo's warnings that invalidate the result.
    """

    at_rest: bool
    time_s: float
    poses: tuple[Pose, ...]
    speeds: Float64[np.ndarray, " n"]
    moving: Bool[np.ndarray, " n"]
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Drift(Frozen):
    """Motion of each body's centre of mass over some further time, its rotation, and the pose at the end.

    `sunk_m` is how far it went down, negative where it rose [m].
    """

    distance_m: Float64[np.ndarray, " n"]
    sunk_m: Float64[np.ndarray, " n"]
    angle_rad: Float64[np.ndarray, " n"]
    poses: tuple[Pose, ...]
    warnings: tuple[str, ...]


def find_free_bodies(model: mujoco.MjModel) -> list[int]:
    """Find the ids of the bodies with a free joint, in the order of the model."""
    return [int(model.jnt_bodyid[j]) for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]


def simulate_to_rest(
    model: mujoco.MjModel, max_time_s: float, gentle: bool = True, lost_below_m: float = -np.inf
) -> Rest:
    """Step the model from its initial state until all free bodies are at rest, or `max_time_s` has passed.

    Args:
        model: Its free bodies are observed.
        max_time_s: Bound on simulated time [s].
        gentle: First sink with strong damping, so that small gaps close without a kick; then move freely.
        lost_below_m: The simulation ends early once the centre of mass of a body is lower than this [m].
    """
    data = make_quiet_data(model)
    bodies = find_free_bodies(model)
    dofs = _list_velocity_indices(model, bodies)
    if gentle:
        _settle_gently(model, data, min(GENTLE_S, max_time_s))
    velocity = data.qvel[dofs]
    samples = max(1, round(HOLD_S / (STEPS_PER_SAMPLE * float(model.opt.timestep))))  # of the speed within `HOLD_S`
    speeds = deque([_compute_speeds(velocity)], maxlen=samples)
    moving = deque([np.ones(len(bodies), dtype=bool)], maxlen=samples)
    held_since, resting, lost = data.time, False, False
    while data.time < max_time_s and not (resting or lost or list_warnings(data)):
        mujoco.mj_step(model, data, nstep=STEPS_PER_SAMPLE)
        before, velocity = velocity, data.qvel[dofs]
        speeds.append(_compute_speeds(velocity))
        accelerations = _compute_speeds(velocity - before) / (STEPS_PER_SAMPLE * model.opt.timestep)
        moving.append(~((speeds[-1] < SPEED_LIMIT) & (accelerations < ACCELERATION_LIMIT)))
        if moving[-1].any():
            held_since = data.time
        resting = data.time - held_since >= HOLD_S
        lost = bool((data.xipos[bodies, 2] < lost_below_m).any())
    poses = read_body_poses(model, data, bodies)
    return Rest(resting, float(data.time), poses, np.max(speeds, axis=0), np.any(moving, axis=0), list_warnings(data))


def measure_drift(model: mujoco.MjModel, duration_s: float) -> Drift:
    """Step the model for `duration_s` from its initial state, nudging every free body, and measure the displacement.

    Bodies at rest sleep meanwhile, which saves most of the time.
    """
    data = make_quiet_data(model)
    mujoco.mj_kinematics(model, data)
    bodies = find_free_bodies(model)
    start_centers, start = data.xipos[bodies].copy(), read_body_poses(model, data, bodies)
    dofs = _list_velocity_indices(model, bodies)
    times = (NUDGE_INTERVAL_S, SLEEP_AFTER_S, duration_s)
    first, awake, steps = (round(min(seconds, duration_s) / model.opt.timestep) for seconds in times)
    data.qvel[dofs] += NUDGES[0]
    mujoco.mj_step(model, data, nstep=first)
    data.qvel[dofs] += NUDGES[1]
    mujoco.mj_step(model, data, nstep=awake - first)
    with allow_sleep(model, DRIFT_SLEEP_TOLERANCE):
        for done in range(awake, steps, STEPS_PER_SLEEP_CHECK):
            mujoco.mj_step(model, data, nstep=min(STEPS_PER_SLEEP_CHECK, steps - done))
            if (data.tree_asleep >= 0).all():
                break  # only moving bodies wake others
    mujoco.mj_kinematics(model, data)
    end = read_body_poses(model, data, bodies)
    angles = [rotation_angle(a.quaternion_wxyz, b.quaternion_wxyz) for a, b in zip(start, end, strict=True)]
    moved = data.xipos[bodies] - start_centers
    return Drift(np.linalg.norm(moved, axis=1), -moved[:, 2], np.array(angles), end, list_warnings(data))


def read_body_poses(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int]) -> tuple[Pose, ...]:
    """Read the poses of free bodies from the generalised positions."""
    rows = (data.qpos[start : start + 7].copy() for start in _list_position_indices(model, bodies))
    return tuple(Pose(row[:3], normalize_quaternion(row[3:])) for row in rows)


def set_poses(model: mujoco.MjModel, data: mujoco.MjData, bodies: Sequence[int], poses: Sequence[Pose]) -> None:
    """Set the poses of free bodies."""
    for start, pose in zip(_list_position_indices(model, bodies), poses, strict=True):
        data.qpos[start : start + 7] = [*pose.position, *pose.quaternion_wxyz]


def make_quiet_data(model: mujoco.MjModel) -> mujoco.MjData:
    """Make simulation data without MuJoCo's log file in the current folder; warnings are read from the data.

    A handler of warnings that the process has set stays.
    """
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(lambda _: None)
    return mujoco.MjData(model)


@contextmanager
def allow_sleep(model: mujoco.MjModel, tolerance: float) -> Iterator[None]:
    """Let MuJoCo put bodies slower than the tolerance [m/s] for ten steps to sleep, with all that they touch.

    Rotation counts by the speed of the body's surface.
    """
    option = model.opt
    own = int(option.enableflags), float(option.sleep_tolerance)
    option.enableflags, option.sleep_tolerance = own[0] | int(mujoco.mjtEnableBit.mjENBL_SLEEP), tolerance
    try:
        yield
    finally:
        option.enableflags, option.sleep_tolerance = own


def _list_velocity_indices(model: mujoco.MjModel, bodies: Sequence[int]) -> Int64[np.ndarray, "n 6"]:
    return model.body_dofadr[list(bodies)].astype(np.int64)[:, None] + np.arange(6)


def _list_position_indices(model: mujoco.MjModel, bodies: Sequence[int]) -> list[int]:
    """List the first index of each free body's position and quaternion in `qpos`."""
    return model.jnt_qposadr[model.body_jntadr[list(bodies)]].tolist()


def _compute_speeds(velocity: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, " n"]:
    return np.abs(velocity).max(axis=1, initial=0.0)


def _settle_gently(model: mujoco.MjModel, data: mujoco.MjData, duration_s: float) -> None:
    decay = float(np.exp(-GENTLE_RATE * model.opt.timestep))
    while data.time < duration_s and not list_warnings(data):
        mujoco.mj_step(model, data)
        data.qvel *= decay


def list_warnings(data: mujoco.MjData) -> tuple[str, ...]:
    """List the names of MuJoCo's warnings that invalidate a simulation."""
    if not data.warning.number.any():
        return ()
    return tuple(kind.name.removeprefix("mjWARN_").lower() for kind in UNSTABLE if data.warning[kind].number)
