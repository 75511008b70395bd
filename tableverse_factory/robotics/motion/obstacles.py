"""The scene's obstacles in the robot's base frame, for planners that want them there (paper, appendix D).

Every object is one mesh: its convex pieces together, the same shapes that the simulator collides. Where that mesh is
open, not manifold or without volume, the object's circumscribed box stands for it, and the obstacle says so.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from schemas.geometry import Frozen, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import compose, identity_pose, transform_points
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes
from tableverse_factory.robotics.motion.world import Space, World

SMALLEST_M3 = 1e-12
"""A mesh of less volume is none [m³]."""
_BOX = trimesh.creation.box((2.0, 2.0, 2.0))


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle(Frozen):
    """Something to keep away from.

    Attributes:
        name: Of its body.
        pose: Its own frame in the robot's base frame: T_planning = T_world→robot · T_asset.
        mesh: In its own frame [m]; None where a box stands for it.
        center: Middle of its box, in its own frame [m].
        size: Edges of that box along its own axes [m].
        boxed: Why a box stands for it; empty for a mesh, and for what is a box.
    """

    name: str
    pose: Pose
    mesh: TriangleMesh | None
    center: Vector3
    size: Vector3
    boxed: str = ""

    @property
    def box_pose(self) -> Pose:
        """The box's middle and axes in the robot's base frame."""
        return compose(self.pose, Pose(self.center, identity_pose().quaternion_wxyz))

    @property
    def listed_pose(self) -> list[float]:
        """`pose` where it is a mesh, else `box_pose`, as x, y, z, qw, qx, qy, qz."""
        pose = self.pose if self.mesh is not None else self.box_pose
        return [*pose.position.tolist(), *pose.quaternion_wxyz.tolist()]


def obstacles(space: Space) -> tuple[Obstacle, ...]:
    """Everything of the scene but what is carried, where it stands in this space."""
    world = space.world
    held = None if space.carried is None else space.carried.object_id
    found = [_table(world)] if world.table_geom is not None else []
    for object_id in world.station.object_ids:
        if object_id != held:
            pose = space.standing.get(object_id, world.object_pose(object_id))
            found.append(arbitrated(object_id, world.in_base(pose), object_mesh(world, object_id)))
    return tuple(found)


def boxed(world: World) -> tuple[str, ...]:
    """Objects for which a box stands, with the reason, in words."""
    meshes = ((name, _fault(object_mesh(world, name))) for name in world.station.object_ids)
    return tuple(f"obstacles: {name} as its box ({why})" for name, why in meshes if why)


def arbitrated(name: str, pose: Pose, mesh: TriangleMesh) -> Obstacle:
    """An object as its mesh, or as its box where the mesh is none that a planner can work with."""
    low, high = aabb(mesh.vertices) if len(mesh.vertices) else (np.zeros(3), np.zeros(3))
    why = _fault(mesh)
    return Obstacle(name, pose, None if why else mesh, (low + high) / 2, high - low, why)


def object_mesh(world: World, object_id: str) -> TriangleMesh:
    """All convex pieces of an object as one mesh in its own frame [m]."""
    model, body = world.station.model, world.station.object_bodies[object_id]
    first = int(model.body_geomadr[body])
    geoms = range(first, first + int(model.body_geomnum[body]))
    return concatenate_meshes(
        [_piece(model, geom) for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    )


def _piece(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """In the body's frame; of primitives their box."""
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


def _table(world: World) -> Obstacle:
    model, geom = world.station.model, world.table_geom
    body = model.geom_bodyid[geom]
    pose = Pose(np.array(model.body_pos[body]), np.array(model.body_quat[body]))
    local = Pose(np.array(model.geom_pos[geom]), np.array(model.geom_quat[geom]))
    return Obstacle(
        "table", world.in_base(compose(pose, local)), None, np.zeros(3), 2 * np.array(model.geom_size[geom])
    )


def _fault(mesh: TriangleMesh) -> str:
    """Why a planner cannot work with a mesh; empty where it can."""
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        return "no surface"
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    if not solid.is_watertight:
        return "open"
    if not solid.is_winding_consistent:
        return "not manifold"
    return "" if abs(float(solid.volume)) > SMALLEST_M3 else "no volume"
