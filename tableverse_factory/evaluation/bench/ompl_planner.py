"""OMPL's RRT-Connect behind the planners' door: the same problems and the same collision checks as ours."""

import importlib.util

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.robotics.motion.rrt import EDGE_STEP_RAD
from tableverse_factory.robotics.motion.world import Space, World

LIMIT_S = 5.0
"""OMPL is bounded by a clock; a problem that takes longer counts as unsolved [s]."""


def has_ompl() -> bool:
    """Whether OMPL is installed (`pip install 'tableverse-factory[bench]'`)."""
    return importlib.util.find_spec("ompl") is not None


class OmplConnect:
    """RRT-Connect of OMPL and its path simplifier, at their defaults; for comparison, never for datasets."""

    def __init__(self) -> None:
        """Silences OMPL.

        Raises:
            ConfigError: if it is not installed.
        """
        if not has_ompl():
            raise ConfigError("OMPL is not installed: pip install 'tableverse-factory[bench]'")
        from ompl import util

        util.noOutputHandler()

    def path(self, start: JointVector, goal: JointVector, space: Space, rng: np.random.Generator) -> JointPath | None:  # noqa: ARG002
        """As `Planner.path`; chance is OMPL's own."""
        from ompl import base, geometric

        joints, chain = len(start), space.world.chain
        vectors = base.RealVectorStateSpace(joints)
        bounds = base.RealVectorBounds(joints)
        for joint in range(joints):
            bounds.setLow(joint, float(chain.lower[joint]))
            bounds.setHigh(joint, float(chain.upper[joint]))
        vectors.setBounds(bounds)
        setup = geometric.SimpleSetup(vectors)
        setup.setStateValidityChecker(lambda state: space.free(np.array([state[k] for k in range(joints)])))
        information = setup.getSpaceInformation()
        information.setStateValidityCheckingResolution(EDGE_STEP_RAD / vectors.getMaximumExtent())
        ends = [vectors.allocState() for _ in range(2)]
        for state, q in zip(ends, (start, goal), strict=True):
            for joint in range(joints):
                state[joint] = float(q[joint])
        setup.setStartAndGoalStates(*ends)
        setup.setPlanner(geometric.RRTConnect(information))
        setup.solve(LIMIT_S)
        if not setup.haveExactSolutionPath():
            return None
        setup.simplifySolution()
        states = setup.getSolutionPath().getStates()
        return np.array([[state[k] for k in range(joints)] for state in states])

    def fallbacks(self, world: World) -> tuple[str, ...]:  # noqa: ARG002
        """Nothing: it asks the scene's own collision check."""
        return ()


def path_length(path: JointPath) -> float:
    """Sum of the lengths of the edges [rad]."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
