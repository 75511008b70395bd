"""Independent validation of a finished motion, from its samples alone and more finely than it was planned.

Servo targets move in straight lines between samples, and so does this check: at steps of at most 0.004 rad of any
joint, at exact geometry, with the carried object. Every motion has to pass it, whichever planner made it.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from schemas.trajectories import JointPath, Motion, NoMotion, Phase
from tableverse_factory.robotics.motion.pick_place import PickPlace
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld

CHECK_STEP_RAD, CHECK_OPENING_STEP_M = 0.004, 0.004
_ROUNDING = 1e-6
_PHASES = list(Phase)


def validate_motion(
    world: CollisionWorld, motion: Motion, object_id: str, width_m: float, config: TrajectoriesConfig
) -> NoMotion | None:
    """Find the first fault of a motion through all six phases, or None.

    `width_m` is the distance between the holding fingers; `config.speed` the usable share of velocity and acceleration.
    """
    if np.unique(motion.phases).tolist() != list(range(len(_PHASES))) or (np.diff(motion.phases) < 0).any():
        return NoMotion(Phase.PRE_GRASP, "not_rechecked", "the six phases are not there in their order")
    return (
        _check_limits(world, motion, config.speed)
        or _check_torques(world, motion, object_id)
        or _check_collisions(world, motion, object_id, width_m)
    )


def _check_limits(world: CollisionWorld, motion: Motion, speed: float) -> NoMotion | None:
    """Check position, velocity, acceleration and continuity."""
    arm, step = world.station.arm, motion.step_s
    q, velocity = motion.positions, motion.velocities
    acceleration = np.diff(velocity, axis=0) / step
    most = speed * arm.max_acceleration
    jump = np.abs(np.diff(q, axis=0) - (velocity[1:] + velocity[:-1]) / 2 * step)
    excess = {
        "position": np.maximum(world.chain.lower - q, q - world.chain.upper),
        "velocity": np.abs(velocity) / (speed * arm.max_velocity) - 1.0,
        "acceleration": np.abs(acceleration) / most - 1.0,
        "continuity": jump / (0.5 * most * step**2) - 1.0,
    }
    for name, values in excess.items():
        sample, joint = np.unravel_index(int(np.argmax(values)), values.shape)
        if values[sample, joint] > _ROUNDING:
            excess_by = values[sample, joint]
            detail = f"{name} of joint {joint + 1} is beyond its limit by {excess_by:.3g} at sample {sample}"
            return NoMotion(_PHASES[motion.phases[sample]], "not_rechecked", detail)
    if np.abs(velocity[[0, -1]]).max() > _ROUNDING:
        return NoMotion(Phase.PRE_GRASP, "not_rechecked", "the motion does not start and end at rest")
    return None


def _check_torques(world: CollisionWorld, motion: Motion, object_id: str) -> NoMotion | None:
    """Check the arm's torques with its payload, by inverse dynamics at every sample."""
    arm, dynamics = world.station.arm, world.dynamics
    acceleration = np.gradient(motion.velocities, motion.step_s, axis=0)
    carried = PickPlace(world, object_id, *_compute_gripper_poses(world, motion), 0.0).carried
    holding = (motion.phases >= _PHASES.index(Phase.POST_GRASP)) & (motion.phases <= _PHASES.index(Phase.PLACE))
    for load in (False, True):
        dynamics.set_payload(world.station, carried if load else None)
        for sample in np.flatnonzero(holding == load):
            torque = dynamics.compute_torques(motion.positions[sample], motion.velocities[sample], acceleration[sample])
            joint = int(np.argmax(np.abs(torque) / arm.max_torque))
            if abs(torque[joint]) > arm.max_torque[joint]:
                detail = f"joint {joint + 1} needs {torque[joint]:.1f} N m at sample {sample}"
                return NoMotion(_PHASES[motion.phases[sample]], "not_rechecked", detail)
    return None


def _check_collisions(world: CollisionWorld, motion: Motion, object_id: str, width_m: float) -> NoMotion | None:
    for phase, space, path in split_by_space(world, motion, object_id, width_m):
        if (hit := space.find_first_collision(path)) is not None:
            detail = f"{world.describe_collision(space, path[hit])} in the finished motion"
            return NoMotion(phase, "not_rechecked", detail)
    return None


def split_by_space(
    world: CollisionWorld, motion: Motion, object_id: str, width_m: float
) -> Iterator[tuple[Phase, CollisionSpace, JointPath]]:
    """Iterate phase, collision space and dense configurations; in pauses, the fingers on their way to the object."""
    q, phases = motion.positions, motion.phases
    grasp, place = (_find_last_sample(motion, phase) for phase in (Phase.GRASP, Phase.PLACE))
    task = PickPlace(world, object_id, *_compute_gripper_poses(world, motion), width_m)
    task = task.allow_grasp_contacts(q[grasp]).allow_release_contacts(q[place])
    opened, released = float(motion.openings[0]), float(motion.openings[-1])
    lifting, lowering = task.holding_space(0.0, task.taken), task.holding_space(0.0, task.released)
    spaces = {
        Phase.PRE_GRASP: task.reaching_space(opened, 0.0),
        Phase.GRASP: task.reaching_space(opened, 0.0),
        Phase.POST_GRASP: lifting,
        Phase.PRE_PLACE: task.holding_space(0.0),
        Phase.PLACE: lowering,
        Phase.POST_PLACE: task.leaving_space(released, 0.0),
    }
    for number, phase in enumerate(_PHASES):
        samples = np.flatnonzero(phases == number)
        first = max(int(samples[0]) - 1, 0)
        yield phase, spaces[phase], _densify(q[first : samples[-1] + 1])
    for phase, at, opening, held in ((Phase.GRASP, grasp, opened, lifting), (Phase.PLACE, place, released, lowering)):
        for wide in np.arange(width_m, opening, CHECK_OPENING_STEP_M):
            yield phase, replace(held, opening_m=float(wide)), q[at : at + 1]


def _densify(path: JointPath) -> JointPath:
    """Interpolate between samples as finely as needed. Shape (n, j)."""
    counts = np.maximum(np.ceil(np.abs(np.diff(path, axis=0)).max(axis=1) / CHECK_STEP_RAD), 1).astype(int)
    counts[np.abs(np.diff(path, axis=0)).max(axis=1) == 0.0] = 0
    marks = [index + np.arange(1, count + 1) / count for index, count in enumerate(counts) if count]
    at = np.concatenate([[0.0], *marks])
    low = np.minimum(at.astype(int), max(len(path) - 2, 0))
    high = np.minimum(low + 1, len(path) - 1)
    return path[low] + (at - low)[:, None] * (path[high] - path[low])


def _find_last_sample(motion: Motion, phase: Phase) -> int:
    return int(np.flatnonzero(motion.phases == _PHASES.index(phase))[-1])


def _compute_gripper_poses(world: CollisionWorld, motion: Motion) -> tuple[Pose, Pose]:
    """Compute the TCP at the grasp and at the release."""
    grasp, place = (_find_last_sample(motion, phase) for phase in (Phase.GRASP, Phase.PLACE))
    return world.tcp(motion.positions[grasp]), world.tcp(motion.positions[place])
