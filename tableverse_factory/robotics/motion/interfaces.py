"""The door to motion planners: a joint path between two configurations, or none."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.robotics.motion.curobo import Curobo
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.motion.world import Space, World


class Planner(Protocol):
    """Finds joint paths. Deterministic in what it is given, and bounded by counts."""

    def path(self, start: JointVector, goal: JointVector, space: Space, rng: np.random.Generator) -> JointPath | None:
        """Corners of a path from start to goal that is free in `space`, both ends included; None where none was found.

        Args:
            start: Shape (j,) [rad].
            goal: Shape (j,) [rad].
            space: What counts as free; the path is checked against it again, whoever made it.
            rng: The only source of chance.
        """
        ...

    def fallbacks(self, world: World) -> tuple[str, ...]:
        """What it settles for in this scene where it cannot see it as it is, in words; nothing as a rule."""
        ...


PLANNERS: dict[str, Callable[[], Planner]] = {"rrt": RrtConnect, "curobo": Curobo}
"""By the name in `trajectories.planner`."""
