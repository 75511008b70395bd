"""The door behind which grasps are found, and what every answer goes through: room for the gripper."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Points, TriangleMesh
from schemas.trajectories import Grasps
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes, placed_mesh
from tableverse_factory.geometry.relations.antipodal import surface_points
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.physics.mjcf.shape import shape_of
from tableverse_factory.robotics.grasps.antipodal import sample
from tableverse_factory.robotics.grasps.clearance import clear
from tableverse_factory.robotics.grasps.closing import closed
from tableverse_factory.robotics.grasps.remote import ask
from tableverse_factory.robotics.robots.arm import Arm

_OWN_POINTS = 1000
_PIECE_POINTS = 500


class GraspModel(Protocol):
    """Says how a gripper could take hold of a thing if nothing else were there."""

    def __call__(
        self, thing: SceneObject, arm: Arm, config: TrajectoriesConfig, rng: np.random.Generator, services: Services
    ) -> Grasps:
        """Grasps of the thing as it stands, table frame, with widths and scores.

        Raises:
            ModelError: if a model does not answer, or not what it should.
        """
        ...


def antipodal(
    thing: SceneObject,
    arm: Arm,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
    services: Services,  # noqa: ARG001
) -> Grasps:
    """Pairs of contacts on the mesh (`grasps.antipodal`)."""
    center = transform_points(thing.pose, shape_of(thing.mesh, thing.hulls, 1.0).moments.center[None])[0]
    return sample(thing.standing, _felt(thing), arm.shape, arm.max_opening_m, center, config, rng)


def graspgen(
    thing: SceneObject,
    arm: Arm,
    config: TrajectoriesConfig,
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,
) -> Grasps:
    """What a server says of the mesh (`grasps.remote`), closed on the pieces."""
    return closed(ask(thing.standing, config, services), _felt(thing), arm.shape, arm.max_opening_m)


GRASP_MODELS: dict[str, GraspModel] = {"antipodal": antipodal, "graspgen": graspgen}


def grasps_of(
    thing: SceneObject,
    others: Iterable[SceneObject],
    arm: Arm,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
    services: Services,
) -> Grasps:
    """Grasps of a thing that have room among others; which of them to try first is `grasps.arbitration`'s to say.

    They are not arbitrated here: where none of a stage can be reached either, the next stage has its turn.

    Raises:
        ModelError: see `GraspModel`.
    """
    found = GRASP_MODELS[config.grasp_model](thing, arm, config, rng, services)
    pieces = [placed_mesh(hull, other.pose) for other in others for hull in other.hulls]
    room = clear(found, arm.shape, arm.max_opening_m, _own_points(thing), pieces)
    return found.chosen(np.flatnonzero(room).astype(np.int32))


def _felt(thing: SceneObject) -> TriangleMesh:
    """The convex pieces as they stand, as one mesh."""
    return placed_mesh(concatenate_meshes(thing.hulls), thing.pose)


def _own_points(thing: SceneObject) -> Points:
    """Points of the surface, and of the pieces that a simulation feels in its place."""
    pieces = [placed_mesh(hull, thing.pose) for hull in thing.hulls]
    each = max(_PIECE_POINTS // max(len(pieces), 1), 16)
    shares = [(thing.standing, _OWN_POINTS), *((piece, each) for piece in pieces)]
    return np.concatenate([surface_points(mesh, count)[0] for mesh, count in shares])
