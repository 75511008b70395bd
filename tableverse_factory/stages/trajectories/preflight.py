"""Availability check of robot, planner and grasp model before a build."""

import importlib.util
from pathlib import Path
from tempfile import TemporaryDirectory

import trimesh

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.grasps.remote import request_grasps
from tableverse_factory.robotics.motion.curobo import ROBOT_FILES
from tableverse_factory.robotics.motion.interfaces import PLANNERS
from tableverse_factory.robotics.robots.registry import load_arm

_CUBE_M = 0.05


def check_trajectory_models(config: TrajectoriesConfig, here: bool) -> None:
    """Load the robot and planner, and query the grasp server once.

    Only if the stages run `here`, on this machine, do its GPU and network say something about theirs.
    """
    arm = load_arm(config.robot)
    if config.planner == "curobo":
        _check_curobo(arm.name, here)
    if config.grasp_model == "graspgen" and here:
        _check_grasp_server(config)


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


def _check_grasp_server(config: TrajectoriesConfig) -> None:
    """Request grasps of a cube on the table, with a temporary cache."""
    cube = from_trimesh(
        trimesh.creation.box((_CUBE_M,) * 3, trimesh.transformations.translation_matrix((0, 0, _CUBE_M / 2)))
    )
    with TemporaryDirectory() as folder:
        request_grasps(cube, config, Services(Path(folder)))
