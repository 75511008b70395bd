"""Grasp models by name, and the clearance test that all proposed grasps pass."""

from collections.abc import Callable, Iterable

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Points, TriangleMesh
from schemas.trajectories import Grasps
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes, place_mesh
from tableverse_factory.geometry.relations.antipodal import sample_inward_normals
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.physics.mjcf.shape import make_body_shape
from tableverse_factory.robotics.grasps.antipodal import sample_antipodal_grasps
from tableverse_factory.robotics.grasps.clearance import find_clear_grasps
from tableverse_factory.robotics.grasps.closing import close_grasps
from tableverse_factory.robotics.grasps.remote import request_grasps
from tableverse_factory.robotics.robots.arm import Arm

_MESH_POINTS, _PIECE_POINTS = 1000, 500


# Proposes grasps of an isolated object, in the table frame, with widths and scores; or raises a ModelError
GraspModel = Callable[[SceneObject, Arm, TrajectoriesConfig, np.random.Generator, Services], Grasps]


def propose_antipodal(
    target: SceneObject, arm: Arm, config: TrajectoriesConfig, rng: np.random.Generator, _services: Services
) -> Grasps:
    """Sample pairs of contacts on the mesh (`grasps.antipodal`)."""
    center = transform_points(target.pose, make_body_shape(target.mesh, target.hulls, 1.0).moments.center[None])[0]
    return sample_antipodal_grasps(
        target.standing, _merge_pieces(target), arm.shape, arm.max_opening_m, center, config, rng
    )


def propose_graspgen(
    target: SceneObject, arm: Arm, config: TrajectoriesConfig, _rng: np.random.Generator, services: Services
) -> Grasps:
    """Request grasps from a server (`grasps.remote`), closed on the pieces."""
    found = request_grasps(target.standing, config, services)
    return close_grasps(found, _merge_pieces(target), arm.shape, arm.max_opening_m)


GRASP_MODELS: dict[str, GraspModel] = {"antipodal": propose_antipodal, "graspgen": propose_graspgen}


def propose_grasps(
    target: SceneObject,
    others: Iterable[SceneObject],
    arm: Arm,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
    services: Services,
) -> Grasps:
    """Propose grasps of an object that leave the gripper clear of the others, not yet arbitrated."""
    found = GRASP_MODELS[config.grasp_model](target, arm, config, rng, services)
    pieces = [place_mesh(hull, other.pose) for other in others for hull in other.hulls]
    room = find_clear_grasps(found, arm.shape, arm.max_opening_m, _sample_surface(target), pieces)
    return found.select(np.flatnonzero(room).astype(np.int32))


def _merge_pieces(target: SceneObject) -> TriangleMesh:
    """Merge the convex pieces, in the table frame, into one mesh."""
    return place_mesh(concatenate_meshes(target.hulls), target.pose)


def _sample_surface(target: SceneObject) -> Points:
    """Sample points of the surface and of the convex pieces, which a simulation collides instead."""
    pieces = [place_mesh(hull, target.pose) for hull in target.hulls]
    each = max(_PIECE_POINTS // max(len(pieces), 1), 16)
    shares = [(target.standing, _MESH_POINTS), *((piece, each) for piece in pieces)]
    return np.concatenate([sample_inward_normals(mesh, count)[0] for mesh, count in shares])
