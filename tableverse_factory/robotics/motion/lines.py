"""Straight lines of the TCP: how far an arm can go along one, and how far it is free."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Pose, Vector3
from schemas.trajectories import JointPath
from tableverse_factory.geometry.math.transforms import translated
from tableverse_factory.robotics.motion.kinematics import Configurations, follow
from tableverse_factory.robotics.motion.world import Space, World

SPACING_M = 0.005
"""Between the poses whose configurations are solved for; between them the TCP strays by hundredths of a millimetre."""


@dataclass(frozen=True, slots=True, eq=False)
class Line(Frozen):
    """Configurations along a straight motion of the TCP that keeps its orientation.

    Attributes:
        path: From the end where something is touched to the free end. Shape (n, j) [rad].
        length_m: How far it goes; less than was asked for where the arm or the scene ends it [m].
        blocked_by: What ended it; empty where it goes all the way.
    """

    path: JointPath
    length_m: float
    blocked_by: str


def lines(
    world: World, space: Space, touching: Configurations, tcp: Pose, direction: Vector3, length_m: float
) -> list[Line]:
    """One line for each configuration at a pose, as far as it goes.

    Args:
        world: The arm.
        space: What counts as free on the line.
        touching: Configurations whose TCP is at `tcp`. Shape (b, j) [rad].
        tcp: In the table frame.
        direction: Unit vector in the table frame.
        length_m: How far at most [m].
    """
    count = int(np.ceil(length_m / SPACING_M - 1e-9))
    away = [translated(tcp, np.asarray(direction) * (length_m * k / count)) for k in range(1, count + 1)]
    rows, reached = follow(world.chain, touching, [world.in_base(pose) for pose in away])
    found = []
    for branch, steps in enumerate(reached.tolist()):
        path = np.concatenate([touching[branch][None], rows[:steps, branch]])
        hit = space.first_hit(path)
        why = "" if steps == count else "the arm's reach"
        if hit is not None:
            why, steps = world.blocked_by(space, path[hit]), hit - 1
        found.append(Line(path[: steps + 1], length_m * max(steps, 0) / count, why))
    return found
