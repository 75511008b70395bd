"""Whether robot, planner and grasp model are there, asked before a dataset waits for them."""

import importlib.util
from pathlib import Path
from tempfile import TemporaryDirectory

import trimesh

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.grasps.remote import ask
from tableverse_factory.robotics.motion.curobo import ROBOT_FILES
from tableverse_factory.robotics.motion.interfaces import PLANNERS
from tableverse_factory.robotics.robots.registry import arm_of

_TRIAL_M = 0.05


def check_all(config: TrajectoriesConfig, here: bool) -> None:
    """Reads the robot, loads the planner and asks the grasp server once.

    Args:
        config: The names.
        here: Whether the stages run on this machine: else its GPU and what it reaches say nothing about theirs.

    Raises:
        ConfigError: if there is no such robot, or its planner is not installed or does not know it.
        InputError: if the robot's file is no arm.
        ModelAccessError: if the grasp server refuses to be asked.
        ModelError: if the planner finds no GPU, or the grasp server gives no answer or none that is one.
    """
    arm = arm_of(config.robot)
    if config.planner == "curobo":
        _check_curobo(arm.name, here)
    if config.grasp_model == "graspgen" and here:
        _ask_once(config)


def _check_curobo(robot: str, here: bool) -> None:
    if robot not in ROBOT_FILES:
        known = ", ".join(ROBOT_FILES)
        raise ConfigError(
            f"cuRobo has no file of the robot {robot!r:.80}, only of {known}: give trajectories.planner=rrt"
        )
    missing = [name for name in ("curobo", "torch") if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"trajectories.planner=curobo needs {' and '.join(missing)}, not installed here: PyTorch, an NVIDIA GPU, "
            "and cuRobo 0.8 or later from its own repository (the names on PyPI are empty); trajectories.planner=rrt "
            "needs none of them"
        )
    if here:
        PLANNERS["curobo"]()


def _ask_once(config: TrajectoriesConfig) -> None:
    """About a cube on the table; nothing of it is kept."""
    cube = from_trimesh(
        trimesh.creation.box((_TRIAL_M,) * 3, trimesh.transformations.translation_matrix((0, 0, _TRIAL_M / 2)))
    )
    with TemporaryDirectory() as folder:
        ask(cube, config, Services(Path(folder)))
