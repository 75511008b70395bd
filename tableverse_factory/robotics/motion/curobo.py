"""Experimental: cuRobo (0.8 or later) behind the planners' door: trajectory optimisation on an NVIDIA GPU.

Written after its documented interface and never run on a GPU; only the mapping of the obstacles is tested.

It is asked for joint paths alone; grasps, straight lines, timing and the final check stay ours, so that what leaves is
held to the same bounds whoever planned it. Its obstacles stand in the robot's base frame (`motion.obstacles`), and what
is carried is attached to the hand as spheres. Where its random sequence starts is reset before every path.
"""

import importlib
from typing import Any

import numpy as np

from schemas.trajectories import JointPath, JointVector
from tableverse_factory.core.errors import ModelError
from tableverse_factory.geometry.math.transforms import compose
from tableverse_factory.robotics.motion.obstacles import Obstacle, boxed, object_mesh, obstacles
from tableverse_factory.robotics.motion.world import Space, World

ROBOT_FILES = {"panda": "franka.yml"}
"""Our arms by the robot file that comes with cuRobo."""
MESH_CACHE = {"mesh": 64, "cuboid": 64}
"""Most obstacles of a scene: its buffers are made once."""
ATTEMPTS = 5
_LINK = "attached_object"
_INSTALL = (
    "trajectories.planner = curobo needs the package curobo (0.8 or later, from its repository: the names on PyPI are "
    "empty), PyTorch and an NVIDIA GPU; trajectories.planner = rrt needs none of them"
)


class Curobo:
    """The planner that needs a GPU. Experimental: it has never been run on one."""

    def __init__(self) -> None:
        """Loads the package.

        Raises:
            ModelError: if cuRobo or PyTorch is not installed, or there is no GPU.
        """
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

    def path(self, start: JointVector, goal: JointVector, space: Space, rng: np.random.Generator) -> JointPath | None:  # noqa: ARG002
        """Configurations along a path, or None. Its own random sequence starts anew each time.

        Args:
            start: Shape (j,) [rad].
            goal: Shape (j,) [rad].
            space: Its obstacles are given to cuRobo; what comes back is checked against it.
            rng: Not used.

        Raises:
            ModelError: if cuRobo has no file of this arm.
        """
        planner = self._planner(space.world.station.arm.name)
        around = obstacles(space)
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
        return path if space.first_hit(path) is None else None

    def fallbacks(self, world: World) -> tuple[str, ...]:
        """Objects that it sees as their box."""
        return boxed(world)

    def _planner(self, arm: str) -> Any:
        if arm not in ROBOT_FILES:
            known = ", ".join(ROBOT_FILES)
            raise ModelError(f"cuRobo has no file of the arm {arm!r}, only of {known}: use trajectories.planner = rrt")
        if arm not in self._planners:
            config = self._motion.MotionPlannerCfg.create(robot=ROBOT_FILES[arm], collision_cache=MESH_CACHE)
            self._planners[arm] = self._motion.MotionPlanner(config)
            self._planners[arm].warmup(enable_graph=True)
        return self._planners[arm]

    def _scene_of(self, around: tuple[Obstacle, ...]) -> Any:
        meshes = [_mesh_arguments(obstacle) for obstacle in around if obstacle.mesh is not None]
        boxes = [_box_arguments(obstacle) for obstacle in around if obstacle.mesh is None]
        return self._scene.Scene(
            mesh=[self._scene.Mesh(**arguments) for arguments in meshes],
            cuboid=[self._scene.Cuboid(**arguments) for arguments in boxes],
        )

    def _state(self, planner: Any, q: JointVector) -> Any:
        position = self._torch.tensor(q[None], dtype=self._torch.float32, device="cuda")
        return self._types.JointState.from_position(position, joint_names=planner.joint_names)

    def _attach(self, planner: Any, state: Any, q: JointVector, space: Space) -> None:
        """Hangs the carried object into the gripper, as it hangs at a configuration."""
        if space.carried is None:
            return
        world, carried = space.world, space.carried
        pose = world.in_base(compose(world.tcp(q), carried.object_to_tcp))
        mesh = object_mesh(world, carried.object_id)
        obstacle = Obstacle(carried.object_id, pose, mesh, np.zeros(3), np.zeros(3))
        offset = self._types.Pose.from_list(obstacle.listed_pose)
        still = self._scene.Mesh(**(_mesh_arguments(obstacle) | {"pose": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}))
        planner.attachment_manager.attach(state, [still], link_name=_LINK, world_objects_pose_offset=offset)


def _mesh_arguments(obstacle: Obstacle) -> dict[str, Any]:
    """Of `curobo.scene.Mesh`."""
    mesh = obstacle.mesh
    if mesh is None:
        raise ValueError(f"{obstacle.name} is a box")
    return {
        "name": obstacle.name,
        "vertices": mesh.vertices.tolist(),
        "faces": mesh.faces.tolist(),
        "pose": obstacle.listed_pose,
    }


def _box_arguments(obstacle: Obstacle) -> dict[str, Any]:
    """Of `curobo.scene.Cuboid`."""
    return {"name": obstacle.name, "dims": obstacle.size.tolist(), "pose": obstacle.listed_pose}
