"""Obstacles in the robot's base frame, for planners that need them there (paper, appendix D).

Every object is one mesh: its convex pieces together, the shapes that the simulator collides. A mesh that is open, not
manifold or without volume is replaced by the object's bounding box, and the obstacle records why.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from schemas.geometry import Frozen, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import compose_poses, identity_pose, transform_points
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld

MIN_VOLUME_M3 = 1e-12  # A mesh of less volume is replaced by its box [m³]
_BOX = trimesh.creation.box((2.0, 2.0, 2.0))


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle(Frozen):
    """Obstacle of a planner, one mesh or box."""

    name: str  # of its body
    pose: Pose  # its own frame in the robot's base frame: T_planning = T_world→robot · T_asset
    mesh: TriangleMesh | None  # in its own frame [m]; None where a box replaces it
    center: Vector3  # middle of its box, in its own frame [m]
    size: Vector3  # edge lengths of that box along its own axes [m]
    boxed: str = ""  # why a box replaces the mesh; empty for a mesh, and for true boxes

    @property
    def box_pose(self) -> Pose:
        """Middle and axes of the box in the robot's base frame."""
        return compose_poses(self.pose, Pose(self.center, identity_pose().quaternion_wxyz))

    @property
    def listed_pose(self) -> list[float]:
        """`pose` of a mesh, else `box_pose`, as x, y, z, qw, qx, qy, qz."""
        pose = self.pose if self.mesh is not None else self.box_pose
        return [*pose.position.tolist(), *pose.quaternion_wxyz.tolist()]


def list_obstacles(space: CollisionSpace) -> tuple[Obstacle, ...]:
    """List the scene's obstacles, without the carried object, as they stand in this space."""
    world = space.world
    held = None if space.carried is None else space.carried.object_id
    found = [_build_table(world)] if world.table_geom is not None else []
    for object_id in world.station.object_ids:
        if object_id != held:
            pose = space.standing.get(object_id, world.object_pose(object_id))
            found.append(build_obstacle(object_id, world.in_base(pose), merge_object_pieces(world, object_id)))
    return tuple(found)


def list_boxed_objects(world: CollisionWorld) -> tuple[str, ...]:
    """List objects that are replaced by their box, with the reason, in words."""
    meshes = ((name, _find_mesh_fault(merge_object_pieces(world, name))) for name in world.station.object_ids)
    return tuple(f"obstacles: {name} as its box ({why})" for name, why in meshes if why)


def build_obstacle(name: str, pose: Pose, mesh: TriangleMesh) -> Obstacle:
    """Build the obstacle of a mesh, or of its box where a planner cannot work with the mesh."""
    low, high = aabb(mesh.vertices) if len(mesh.vertices) else (np.zeros(3), np.zeros(3))
    why = _find_mesh_fault(mesh)
    return Obstacle(name, pose, None if why else mesh, (low + high) / 2, high - low, why)


def merge_object_pieces(world: CollisionWorld, object_id: str) -> TriangleMesh:
    """Merge all convex pieces of an object into one mesh in its own frame [m]."""
    model, body = world.station.model, world.station.object_bodies[object_id]
    first = int(model.body_geomadr[body])
    geoms = range(first, first + int(model.body_geomnum[body]))
    return concatenate_meshes(
        [_load_piece(model, geom) for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    )


def _load_piece(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """Load a geom in its body's frame; primitives become boxes."""
    pose = Pose(np.array(model.geom_pos[geom]), np.array(model.geom_quat[geom]))
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        at, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        vertices = np.array(model.mesh_vert[at : at + count], dtype=np.float64)
        return TriangleMesh(transform_points(pose, vertices), np.array(model.mesh_face[face : face + faces]))
    center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    corners = transform_points(pose, np.asarray(_BOX.vertices) * half + center)
    return TriangleMesh(corners, np.array(_BOX.faces, dtype=np.int32))


def _build_table(world: CollisionWorld) -> Obstacle:
    model, geom = world.station.model, world.table_geom
    body = model.geom_bodyid[geom]
    pose = Pose(np.array(model.body_pos[body]), np.array(model.body_quat[body]))
    local = Pose(np.array(model.geom_pos[geom]), np.array(model.geom_quat[geom]))
    return Obstacle(
        "table", world.in_base(compose_poses(pose, local)), None, np.zeros(3), 2 * np.array(model.geom_size[geom])
    )


def _find_mesh_fault(mesh: TriangleMesh) -> str:
    """Find why a planner cannot work with a mesh; empty where it can."""
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        return "no surface"
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    if not solid.is_watertight:
        return "open"
    if not solid.is_winding_consistent:
        return "not manifold"
    return "" if abs(float(solid.volume)) > MIN_VOLUME_M3 else "no volume"
