"""Work cell of one scene: its objects, the arm, and caches shared by its tasks."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Points, Pose
from schemas.trajectories import Grasps
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scene_objects import load_scene_objects, read_slab
from tableverse_factory.robotics.grasps.clearance import Mask, find_clear_grasps
from tableverse_factory.robotics.grasps.interfaces import propose_grasps
from tableverse_factory.robotics.motion.interfaces import PLANNERS, Planner
from tableverse_factory.robotics.motion.world import CollisionWorld
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.base import find_bases
from tableverse_factory.robotics.robots.station import Station

MAX_BASES = 3  # base poses tried per task
GRIPPER_REACH_M = 0.3  # maximum distance of any part of an approaching gripper from the grasp


class WorkCell:
    """Objects, table and arm of a scene. Caches depend on the scene alone, never on the order of queries."""

    def __init__(
        self,
        files: Mapping[str, bytes],
        object_rows: Iterable[Mapping[str, Any]],
        arm: Arm,
        config: TrajectoriesConfig,
        rng: np.random.Generator,
        services: Services,
        base: Pose | None = None,
    ) -> None:
        """Read the files and rows of objects/ of an exported scene, and compile it with the arm.

        The arm stands at `base` in the table frame, or wherever a task is best done from.
        """
        self.files = files
        self.objects = load_scene_objects(self.files, object_rows)
        self.table = read_slab(self.files)
        self.station = Station(self.files, arm)
        self.config, self._services, self._base = config, services, base
        self._rngs = dict(zip(self.objects, rng.spawn(len(self.objects)), strict=True))
        placed = {name: [place_mesh(hull, o.pose) for hull in o.hulls] for name, o in self.objects.items()}
        self._pieces = {name: [(piece, aabb(piece.vertices)) for piece in pieces] for name, pieces in placed.items()}
        self._grasps: dict[str, Grasps] = {}
        self._worlds: dict[bytes, CollisionWorld] = {}

    def grasps(self, object_id: str) -> Grasps:
        """Return grasps of an object with clearance from the others."""
        if object_id not in self._grasps:
            others = [scene_object for name, scene_object in self.objects.items() if name != object_id]
            self._grasps[object_id] = propose_grasps(
                self.objects[object_id], others, self.station.arm, self.config, self._rngs[object_id], self._services
            )
        return self._grasps[object_id]

    def has_room(self, object_id: str, grasps: Grasps) -> Mask:
        """Test which grasps have clearance from everything but the object, wherever that is. Shape (n,)."""
        arm = self.station.arm
        low, high = grasps.positions.min(axis=0) - GRIPPER_REACH_M, grasps.positions.max(axis=0) + GRIPPER_REACH_M
        near = [
            piece
            for name, pieces in self._pieces.items()
            for piece, box in pieces
            if name != object_id and (box[0] <= high).all() and (box[1] >= low).all()
        ]
        return find_clear_grasps(grasps, arm.shape, arm.max_opening_m, np.empty((0, 3)), near)

    def bases(self, targets: Points) -> list[Pose]:
        """Find base poses that reach all targets of the table frame [m], first those that reach the whole scene."""
        if self._base is not None:
            return [self._base]
        everything = np.array([scene_object.body.center for scene_object in self.objects.values()])
        common = find_bases(self.station, np.concatenate([everything, targets]), 1)
        own = find_bases(self.station, targets, MAX_BASES)
        apart = [pose for pose in own if not any(np.allclose(pose.position, known.position) for known in common)]
        return [*common, *apart][:MAX_BASES]

    @cached_property
    def planner(self) -> Planner:
        """Planner of this cell, made on first use, as children lose a GPU that their parent holds."""
        return PLANNERS[self.config.planner]()

    def world(self, base: Pose) -> CollisionWorld:
        """Return the collision world with the arm at this base."""
        key = np.concatenate([base.position, base.quaternion_wxyz]).tobytes()
        if key not in self._worlds:
            self._worlds[key] = CollisionWorld(self.station, base)
        return self._worlds[key]
