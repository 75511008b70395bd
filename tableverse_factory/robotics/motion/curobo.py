"""Experimental planner: trajectory optimisation by cuRobo (0.8 or later) on an NVIDIA GPU.

Written after its documented interface and never run on a GPU; only the mapping of the obstacles is tested.

cuRobo plans joint paths only; grasps, straight lines, timing and the final check stay ours, so motions of all planners
meet the same bounds. Obstacles are given in the robot's base frame (`motion.obstacles`), and a carried object is
attached to the hand as spheres. The random sequence is reset before every path.
"""

import importlib
from typing import Any

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.core.errors import ModelError
from tableverse_factory.geometry.math.transforms import compose_poses
from tableverse_factory.robotics.motion.obstacles import (
    Obstacle,
    list_boxed_objects,
    list_obstacles,
    merge_object_pieces,
)
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld

ROBOT_FILES = {"panda": "franka.yml"}  # cuRobo's robot file by arm name
COLLISION_CACHE = {"mesh": 64, "cuboid": 64}  # maximum number of obstacles of a scene: its buffers are allocated once
ATTEMPTS = 5
_ATTACHED_LINK = "attached_object"
_INSTALL = (
    "trajectories.planner = curobo needs the package curobo (0.8 or later, from its repository: the names on PyPI are "
    "empty), PyTorch and an NVIDIA GPU; trajectories.planner = rrt needs none of them"
)


class CuroboPlanner:
    """Experimental GPU planner; never run on a GPU."""

    def __init__(self) -> None:
        """Load the package, which needs a GPU."""
        try:
            self._torch: Any = importlib.import_module("torch")
            self._motion: Any = importlib.import_module("curobo.motion_planner")
            self._scene: Any = importlib.import_module("curobo.scene")
            self._types: Any = importlib.import_module("curobo.types")
        except ImportError as error:
            raise ModelError(f"{_INSTALL} ({error})") from error
        if not self._torch.cuda.is_available():
            raise ModelError(f"{_INSTALL} (PyTorch sees no GPU)")
        self._planners: dict[str, Any] = {}

    def plan_path(
        self, start: JointVector, goal: JointVector, space: CollisionSpace, _rng: np.random.Generator
    ) -> JointPath | None:
        """Plan a path, checked against `space`, or return None; cuRobo restarts its own random sequence."""
        planner = self._planner(space.world.station.arm.name)
        around = list_obstacles(space)
        planner.update_world(self._scene_of(around))
        planner.reset_seed()
        begin, end = (self._state(planner, q) for q in (start, goal))
        self._attach(planner, begin, start, space)
        try:
            result = planner.plan_cspace(end, begin, max_attempts=ATTEMPTS)
        finally:
            planner.attachment_manager.detach()
        if result is None or not bool(result.success.any()):
            return None
        found = result.get_interpolated_plan().position.reshape(-1, len(start)).cpu().numpy().astype(np.float64)
        path = np.concatenate([start[None], found, goal[None]])
        return path if space.find_first_collision(path) is None else None

    def list_fallbacks(self, world: CollisionWorld) -> tuple[str, ...]:
        """List objects that are represented by their box."""
        return list_boxed_objects(world)

    def _planner(self, arm: str) -> Any:
        if arm not in ROBOT_FILES:
            known = ", ".join(ROBOT_FILES)
            raise ModelError(f"cuRobo has no file of the arm {arm!r}, only of {known}: use trajectories.planner = rrt")
        if arm not in self._planners:
            config = self._motion.MotionPlannerCfg.create(robot=ROBOT_FILES[arm], collision_cache=COLLISION_CACHE)
            self._planners[arm] = self._motion.MotionPlanner(config)
            self._planners[arm].warmup(enable_graph=True)
        return self._planners[arm]

    def _scene_of(self, around: tuple[Obstacle, ...]) -> Any:
        return self._scene.Scene(
            mesh=[self._scene.Mesh(**_describe_obstacle(o)) for o in around if o.mesh is not None],
            cuboid=[self._scene.Cuboid(**_describe_obstacle(o)) for o in around if o.mesh is None],
        )

    def _state(self, planner: Any, q: JointVector) -> Any:
        position = self._torch.tensor(q[None], dtype=self._torch.float32, device="cuda")
        return self._types.JointState.from_position(position, joint_names=planner.joint_names)

    def _attach(self, planner: Any, state: Any, q: JointVector, space: CollisionSpace) -> None:
        """Attach the carried object to the gripper at configuration `q`."""
        if space.carried is None:
            return
        world, carried = space.world, space.carried
        pose = world.in_base(compose_poses(world.tcp(q), carried.object_to_tcp))
        mesh = merge_object_pieces(world, carried.object_id)
        obstacle = Obstacle(carried.object_id, pose, mesh, np.zeros(3), np.zeros(3))
        offset = self._types.Pose.from_list(obstacle.listed_pose)
        still = self._scene.Mesh(**(_describe_obstacle(obstacle) | {"pose": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}))
        planner.attachment_manager.attach(state, [still], link_name=_ATTACHED_LINK, world_objects_pose_offset=offset)


def _describe_obstacle(obstacle: Obstacle) -> dict[str, Any]:
    """Build arguments of `curobo.scene.Mesh` or, without a mesh, of `Cuboid`."""
    placed, mesh = {"name": obstacle.name, "pose": obstacle.listed_pose}, obstacle.mesh
    if mesh is None:
        return {**placed, "dims": obstacle.size.tolist()}
    return {**placed, "vertices": mesh.vertices.tolist(), "faces": mesh.faces.tolist()}
