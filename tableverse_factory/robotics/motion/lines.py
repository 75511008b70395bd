"""Straight lines of the TCP: how far an arm reaches along one, and how far it is free."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Pose, Vector3
from schemas.trajectories import JointPath
from tableverse_factory.geometry.math.transforms import translate_pose
from tableverse_factory.robotics.motion.kinematics import Configurations, follow_poses
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld

SPACING_M = 0.005  # distance between solved poses; between them the TCP strays by hundredths of a millimeter


@dataclass(frozen=True, slots=True, eq=False)
class CartesianLine(Frozen):
    """Configurations along a straight motion of the TCP at constant orientation.

    Attributes:
        path: From the contact end to the free end. Shape (n, j) [rad].
        length_m: Length reached; less than requested where the arm or the scene ends it [m].
        blocked_by: What ended it; empty for full length.
    """

    path: JointPath
    length_m: float
    blocked_by: str


def trace_lines(
    world: CollisionWorld,
    space: CollisionSpace,
    touching: Configurations,
    tcp: Pose,
    direction: Vector3,
    length_m: float,
) -> list[CartesianLine]:
    """Trace a line along a unit vector of the table frame from each configuration at `tcp`, as far as it is free."""
    count = int(np.ceil(length_m / SPACING_M - 1e-9))
    away = [translate_pose(tcp, np.asarray(direction) * (length_m * k / count)) for k in range(1, count + 1)]
    rows, reached = follow_poses(world.chain, touching, [world.in_base(pose) for pose in away])
    found = []
    for branch, steps in enumerate(reached.tolist()):
        path = np.concatenate([touching[branch][None], rows[:steps, branch]])
        hit = space.find_first_collision(path)
        why = "" if steps == count else "the arm's reach"
        if hit is not None:
            why, steps = world.describe_collision(space, path[hit]), hit - 1
        found.append(CartesianLine(path[: steps + 1], length_m * max(steps, 0) / count, why))
    return found
