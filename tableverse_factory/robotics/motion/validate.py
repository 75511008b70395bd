"""A finished motion looked at again, from its samples alone and far more finely than it was planned.

Between samples the servos' targets move in straight lines, and so does this: at steps of at most 0.004 rad of any
joint, at exact geometry, with the carried object. Whoever made the motion, and however, this is what it has to hold.
"""

from collections.abc import Iterator

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from schemas.trajectories import JointPath, Motion, NoMotion, Phase
from tableverse_factory.robotics.motion.pick_place import Handling
from tableverse_factory.robotics.motion.world import Space, World

STEP_RAD = 0.004
OPENING_STEP_M = 0.004
_ROUNDING = 1e-6
_PHASES = list(Phase)


def recheck(
    world: World, motion: Motion, object_id: str, width_m: float, config: TrajectoriesConfig
) -> NoMotion | None:
    """What is wrong with a motion, or None.

    Args:
        world: Robot and scene.
        motion: Through all six phases.
        object_id: What it takes.
        width_m: Distance between the fingers that hold it [m].
        config: `speed`: share of the arm's velocity and acceleration that may be used.
    """
    if np.unique(motion.phases).tolist() != list(range(len(_PHASES))) or (np.diff(motion.phases) < 0).any():
        return NoMotion(Phase.PRE_GRASP, "not_rechecked", "the six phases are not there in their order")
    return (
        _limits(world, motion, config.speed)
        or _torques(world, motion, object_id)
        or _touches(world, motion, object_id, width_m)
    )


def _limits(world: World, motion: Motion, speed: float) -> NoMotion | None:
    """Position, velocity, acceleration, and that no sample jumps."""
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
            detail = (
                f"{name} of joint {joint + 1} is beyond its limit by {values[sample, joint]:.3g} at sample {sample}"
            )
            return NoMotion(_PHASES[motion.phases[sample]], "not_rechecked", detail)
    if np.abs(velocity[[0, -1]]).max() > _ROUNDING:
        return NoMotion(Phase.PRE_GRASP, "not_rechecked", "the motion does not start and end at rest")
    return None


def _torques(world: World, motion: Motion, object_id: str) -> NoMotion | None:
    """Of the arm with its load, by inverse dynamics at every sample."""
    arm, dynamics = world.station.arm, world.dynamics
    acceleration = np.gradient(motion.velocities, motion.step_s, axis=0)
    carried = Handling(world, object_id, *_ends(world, motion), 0.0).carried
    holding = (motion.phases >= _PHASES.index(Phase.POST_GRASP)) & (motion.phases <= _PHASES.index(Phase.PLACE))
    for load in (False, True):
        dynamics.carry(world.station, carried if load else None)
        for sample in np.flatnonzero(holding == load):
            torque = dynamics.torques(motion.positions[sample], motion.velocities[sample], acceleration[sample])
            joint = int(np.argmax(np.abs(torque) / arm.max_torque))
            if abs(torque[joint]) > arm.max_torque[joint]:
                detail = f"joint {joint + 1} needs {torque[joint]:.1f} N m at sample {sample}"
                return NoMotion(_PHASES[motion.phases[sample]], "not_rechecked", detail)
    return None


def _touches(world: World, motion: Motion, object_id: str, width_m: float) -> NoMotion | None:
    for phase, space, path in stretches(world, motion, object_id, width_m):
        hit = space.first_hit(path)
        if hit is not None:
            return NoMotion(phase, "not_rechecked", f"{world.blocked_by(space, path[hit])} in the finished motion")
    return None


def stretches(world: World, motion: Motion, object_id: str, width_m: float) -> Iterator[tuple[Phase, Space, JointPath]]:
    """Phase, what may touch what, and the configurations to look at, over the whole motion.

    Where the fingers close and open, the arm stands: the fingers are looked at on their way, the object between them.
    """
    q, phases = motion.positions, motion.phases
    grasp, place = (_last(motion, phase) for phase in (Phase.GRASP, Phase.PLACE))
    handling = Handling(world, object_id, *_ends(world, motion), width_m)
    handling = handling.taken_at(q[grasp]).released_at(q[place])
    opened, released = float(motion.openings[0]), float(motion.openings[-1])
    lifting, lowering = handling.lifting(0.0), handling.lowering(0.0)
    spaces = {
        Phase.PRE_GRASP: handling.reaching(opened, 0.0),
        Phase.GRASP: handling.reaching(opened, 0.0),
        Phase.POST_GRASP: lifting,
        Phase.PRE_PLACE: handling.carrying(0.0),
        Phase.PLACE: lowering,
        Phase.POST_PLACE: handling.leaving(released, 0.0),
    }
    for number, phase in enumerate(_PHASES):
        samples = np.flatnonzero(phases == number)
        first = max(int(samples[0]) - 1, 0)
        yield phase, spaces[phase], _dense(q[first : samples[-1] + 1])
    stands = ((Phase.GRASP, grasp, opened, lifting), (Phase.PLACE, place, released, lowering))
    for phase, at, opening, resting in stands:
        for wide in np.arange(width_m, opening, OPENING_STEP_M):
            space = world.space(float(wide), carried=handling.carried, resting=resting.resting)
            yield phase, space, q[at : at + 1]


def _dense(path: JointPath) -> JointPath:
    """The samples and as many points between them as are needed. Shape (n, j)."""
    counts = np.maximum(np.ceil(np.abs(np.diff(path, axis=0)).max(axis=1) / STEP_RAD), 1).astype(int)
    counts[np.abs(np.diff(path, axis=0)).max(axis=1) == 0.0] = 0
    marks = [index + np.arange(1, count + 1) / count for index, count in enumerate(counts) if count]
    at = np.concatenate([[0.0], *marks])
    low = np.minimum(at.astype(int), max(len(path) - 2, 0))
    high = np.minimum(low + 1, len(path) - 1)
    dense: JointPath = path[low] + (at - low)[:, None] * (path[high] - path[low])
    return dense


def _last(motion: Motion, phase: Phase) -> int:
    return int(np.flatnonzero(motion.phases == _PHASES.index(phase))[-1])


def _ends(world: World, motion: Motion) -> tuple[Pose, Pose]:
    """The TCP at the grasp and at the release."""
    grasp, place = (world.tcp(motion.positions[_last(motion, phase)]) for phase in (Phase.GRASP, Phase.PLACE))
    return grasp, place
