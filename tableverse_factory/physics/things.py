"""What a compiled MuJoCo model holds, as solids: its free bodies and what they stand on. Works on anybody's MJCF."""

from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import mujoco
import numpy as np
import trimesh

from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import from_trimesh, placed_mesh
from tableverse_factory.geometry.penetration import region_thickness
from tableverse_factory.geometry.repair import closed_solid
from tableverse_factory.geometry.transforms import compose, inverse, matrix_from_pose, pose_from_matrix
from tableverse_factory.physics.rest import free_bodies

_SEGMENTS = 48
_PLANE_REACH_M = 50.0


@dataclass(frozen=True, slots=True, eq=False)
class Thing(Frozen):
    """Geometry that moves as one: a free body with all below it, or everything that stands still.

    Attributes:
        name: Of the free body, `#7` where body 7 has none; `world` for what stands still.
        mesh: All it is seen as, in the frame of the body.
        solids: The same as closed solids, one per geom.
        repaired: Geoms whose mesh is no closed solid as it stands, with what was done, e.g. `obj_003: filled`.
    """

    name: str
    mesh: TriangleMesh
    solids: tuple[manifold3d.Manifold, ...]
    repaired: tuple[str, ...]


def things(model: mujoco.MjModel) -> tuple[tuple[Thing, ...], Thing]:
    """The free bodies of the model in its order, and all that stands still, as they are seen.

    Seen are the geoms that collide with nothing (a body's visual meshes); where a body has none of those, all of them.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    free = free_bodies(model)
    roots = model.body_rootid[model.geom_bodyid]
    still = ~np.isin(roots, free)
    moving = tuple(_thing(model, data, body_name(model, root), root, np.flatnonzero(roots == root)) for root in free)
    return moving, _thing(model, data, "world", 0, np.flatnonzero(still))


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Its name, or `#` and its id where it has none."""
    return model.body(body).name or f"#{body}"


def deepest_overlaps(moving: Sequence[Thing], poses: Sequence[Pose], still: Thing) -> list[tuple[str, str, float]]:
    """Every pair of things whose solids share volume, with the thickness of what they share [m]."""
    placed = [
        [s.transform(matrix_from_pose(pose)[:3]) for s in t.solids] for t, pose in zip(moving, poses, strict=True)
    ]
    named = [*zip((t.name for t in moving), placed, strict=True), (still.name, list(still.solids))]
    found = []
    for i, (name_a, solids_a) in enumerate(named):
        for name_b, solids_b in named[i + 1 :]:
            depth = max((_overlap(a, b) for a in solids_a for b in solids_b), default=0.0)
            if depth > 0.0:
                found.append((name_a, name_b, depth))
    return found


def _overlap(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    low_a, high_a = np.split(np.array(a.bounding_box()), 2)
    low_b, high_b = np.split(np.array(b.bounding_box()), 2)
    if (low_a >= high_b).any() or (low_b >= high_a).any():
        return 0.0
    return max((region_thickness(region) for region in (a ^ b).decompose()), default=0.0)


def _thing(model: mujoco.MjModel, data: mujoco.MjData, name: str, root: int, geoms: np.ndarray) -> Thing:
    ghost = [g for g in geoms if model.geom_contype[g] == 0 and model.geom_conaffinity[g] == 0]
    to_root = inverse(_pose(data.xpos[root], data.xmat[root]))
    meshes, solids, repaired = [], [], []
    for geom in ghost or geoms:
        shape = geom_shape(model, int(geom))
        if shape is None:
            continue
        mesh = placed_mesh(shape, compose(to_root, _pose(data.geom_xpos[geom], data.geom_xmat[geom])))
        meshes.append(mesh)
        closed, note = _solid(mesh)
        solids.append(closed)
        if note:
            repaired.append(f"{model.geom(geom).name or name}: {note}")
    return Thing(name, joined(meshes), tuple(solids), tuple(repaired))


def _solid(mesh: TriangleMesh) -> tuple[manifold3d.Manifold, str]:
    """The mesh as a solid and what was done to close it; its convex hull (`hull`) where no repair helps."""
    try:
        return closed_solid(mesh)
    except GeometryError:
        return manifold3d.Manifold.hull_points(mesh.vertices.copy()), "hull"


def _pose(position: np.ndarray, matrix: np.ndarray) -> Pose:
    homogeneous = np.eye(4)
    homogeneous[:3, :3], homogeneous[:3, 3] = matrix.reshape(3, 3), position
    return pose_from_matrix(homogeneous)


def joined(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """All triangles of meshes of one frame as one mesh, without their colours; empty where there are none."""
    if not meshes:
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def geom_shape(model: mujoco.MjModel, geom: int) -> TriangleMesh | None:
    """A geom as triangles in its own frame; None for kinds without volume of their own (height fields, fields)."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        slab = trimesh.creation.box((2 * _PLANE_REACH_M, 2 * _PLANE_REACH_M, _PLANE_REACH_M))
        slab.apply_translation([0, 0, -_PLANE_REACH_M / 2])
        return from_trimesh(slab)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return from_trimesh(trimesh.creation.box(2 * size))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return from_trimesh(trimesh.creation.cylinder(size[0], 2 * size[1], sections=_SEGMENTS))
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return from_trimesh(trimesh.creation.capsule(2 * size[1], size[0], count=[_SEGMENTS // 2, _SEGMENTS]))
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        radii = np.full(3, size[0]) if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
        ball = from_trimesh(trimesh.creation.icosphere(4))
        return TriangleMesh(ball.vertices * radii, ball.faces)
    return None


def _mesh(model: mujoco.MjModel, index: int) -> TriangleMesh:
    first, count = int(model.mesh_vertadr[index]), int(model.mesh_vertnum[index])
    first_face, faces = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    return TriangleMesh(
        model.mesh_vert[first : first + count].astype(np.float64),
        model.mesh_face[first_face : first_face + faces].astype(np.int32),
    )
