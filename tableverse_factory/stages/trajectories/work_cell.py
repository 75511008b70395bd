"""The work cell of one scene: its things, the arm beside them, and what has been worked out about them so far."""

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Points, Pose, TriangleMesh, Vector3
from schemas.scene import ExportedScene
from schemas.trajectories import Grasps
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scene_objects import load_scene_objects, slab_of
from tableverse_factory.robotics.grasps.clearance import Mask, clear
from tableverse_factory.robotics.grasps.interfaces import grasps_of
from tableverse_factory.robotics.motion.interfaces import PLANNERS, Planner
from tableverse_factory.robotics.motion.world import World
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.base import bases
from tableverse_factory.robotics.robots.station import Station

BASES = 3
"""Places of the base that a task is tried from."""

GRIPPER_REACH_M = 0.3
"""No part of a gripper on its straight way to a grasp is farther from it."""


class WorkCell:
    """Things, table and arm of a scene. What it keeps depends on the scene alone, never on the order of the asking.

    Attributes:
        files: Of the scene, by name.
        things: By object id.
        table: That they stand on.
        station: The scene with the arm.
    """

    def __init__(
        self, scene: ExportedScene, arm: Arm, config: TrajectoriesConfig, rng: np.random.Generator, services: Services
    ) -> None:
        """Reads the scene's files and compiles them with the arm.

        Raises:
            InputError: if the files are not those of an exported scene, or the arm cannot be attached.
            GeometryError: if a mesh does not decode.
        """
        self.files: Mapping[str, bytes] = dict(scene.files)
        self.things = load_scene_objects(self.files, scene.object_rows)
        self.table = slab_of(self.files)
        self.station = Station(self.files, arm)
        self._config, self._services = config, services
        self._rngs = dict(zip(self.things, rng.spawn(len(self.things)), strict=True))
        self._pieces = {
            name: [_boxed(placed_mesh(hull, thing.pose)) for hull in thing.hulls] for name, thing in self.things.items()
        }
        self._grasps: dict[str, Grasps] = {}
        self._worlds: dict[bytes, World] = {}

    def grasps(self, object_id: str) -> Grasps:
        """Grasps of an object that have room among the others.

        Raises:
            ModelError: if the grasp model does not answer.
        """
        if object_id not in self._grasps:
            others = [thing for name, thing in self.things.items() if name != object_id]
            self._grasps[object_id] = grasps_of(
                self.things[object_id],
                others,
                self.station.arm,
                self._config,
                self._rngs[object_id],
                self._services,
            )
        return self._grasps[object_id]

    def has_room(self, object_id: str, grasps: Grasps) -> Mask:
        """Which grasps leave the gripper room among everything but the object, wherever that is. Shape (n,)."""
        arm = self.station.arm
        low, high = grasps.positions.min(axis=0) - GRIPPER_REACH_M, grasps.positions.max(axis=0) + GRIPPER_REACH_M
        near = [
            piece
            for name, pieces in self._pieces.items()
            for piece, box in pieces
            if name != object_id and (box[0] <= high).all() and (box[1] >= low).all()
        ]
        return clear(grasps, arm.shape, arm.max_opening_m, np.empty((0, 3)), near)

    def bases(self, targets: Points) -> list[Pose]:
        """Places for the base from which the TCP reaches all targets, best first: first those for the whole scene.

        Args:
            targets: Table frame. Shape (n, 3) [m].
        """
        everything = np.array([thing.body.center for thing in self.things.values()])
        common = bases(self.station, np.concatenate([everything, targets]), 1)
        own = bases(self.station, targets, BASES)
        apart = [pose for pose in own if not any(np.allclose(pose.position, known.position) for known in common)]
        return [*common, *apart][:BASES]

    @cached_property
    def planner(self) -> Planner:
        """The one of this cell, made where it is first asked for: a GPU that a parent holds is lost in its children.

        Raises:
            ModelError: if it cannot run here.
        """
        return PLANNERS[self._config.planner]()

    def world(self, base: Pose) -> World:
        """What a planner sees with the arm at this base."""
        key = np.concatenate([base.position, base.quaternion_wxyz]).tobytes()
        if key not in self._worlds:
            self._worlds[key] = World(self.station, base)
        return self._worlds[key]


def _boxed(piece: TriangleMesh) -> tuple[TriangleMesh, tuple[Vector3, Vector3]]:
    return piece, aabb(piece.vertices)
