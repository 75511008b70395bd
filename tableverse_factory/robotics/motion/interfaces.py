"""Motion planner interface and planners by name."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.robotics.motion.curobo import CuroboPlanner
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld


class Planner(Protocol):
    """Deterministic joint path planner, bounded by counts."""

    def plan_path(
        self, start: JointVector, goal: JointVector, space: CollisionSpace, rng: np.random.Generator, /
    ) -> JointPath | None:
        """Plan corners of a path that is free in `space`, both ends included, or return None; it is checked again."""
        ...

    def list_fallbacks(self, world: CollisionWorld, /) -> tuple[str, ...]:
        """List approximations the planner makes of this scene, in words."""
        ...


# Planners by the name in `trajectories.planner`
PLANNERS: dict[str, Callable[[], Planner]] = {"rrt": RrtConnect, "curobo": CuroboPlanner}
