"""What a compiled MuJoCo model holds, as solids: its free bodies and what they stand on. Works on anybody's MJCF."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import manifold3d
import mujoco
import numpy as np
import trimesh

from schemas.geometry import Frozen, Points, Pose, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.collision.broad_phase import overlapping_regions, slab_between
from tableverse_factory.geometry.collision.penetration import region_thickness
from tableverse_factory.geometry.math.aabb import aabb, size_around
from tableverse_factory.geometry.math.transforms import (
    compose,
    identity_pose,
    inverse,
    matrix_from_pose,
    pose_from_matrix,
    transform_points,
)
from tableverse_factory.geometry.mesh.mass_integrals import signed_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh, placed_mesh
from tableverse_factory.geometry.mesh.repair import LEAST_FILL, as_solid, closed_solid
from tableverse_factory.geometry.mesh.shells import is_one_shell
from tableverse_factory.physics.mjcf.hidden_geoms import geoms_without_visual
from tableverse_factory.physics.mjcf.inertia import is_closed
from tableverse_factory.physics.simulate.at_rest import free_bodies

_FEW_FACES = 500
"""Of so few the whole solid is made."""

_SEGMENTS = 48
_PLANE_REACH_M = 50.0


class GeomSolid:
    """One geom in the frame of its thing.

    A closed mesh is made a solid only when its box meets another's, and then as little of it as that other can reach:
    solids cost more than all other measures of it.

    Attributes:
        mesh: As it is seen.
        repaired: What was done to a mesh that is no closed solid as it stands, e.g. `obj_003: filled`, or empty.
    """

    def __init__(self, name: str, mesh: TriangleMesh) -> None:
        self._name, self.mesh, self.repaired = name, mesh, ""
        self._solid: manifold3d.Manifold | None = None
        if not is_closed(mesh) or self._is_flat:
            self._closed()

    def points_at(self, pose: Pose) -> Points:
        """Points whose hull the solid fills no more than, where its thing is at this pose."""
        if self.repaired:
            points: Points = self.solid_at(pose).to_mesh64().vert_properties[:, :3].astype(np.float64)
            return points
        return transform_points(pose, self.mesh.vertices)

    def solid_at(self, pose: Pose) -> manifold3d.Manifold:
        """The solid where its thing is at this pose."""
        return self._closed().transform(matrix_from_pose(pose)[:3])

    @cached_property
    def is_plain(self) -> bool:
        """Whether the mesh bounds a solid as it stands, by one surface."""
        if self._solid is not None or not is_one_shell(self.mesh):
            return False
        return signed_volume(self.mesh) > 0.0

    @property
    def _is_flat(self) -> bool:
        """Whether it is closed around nothing: what gives it body changes where it is."""
        return abs(signed_volume(self.mesh)) <= LEAST_FILL * float(size_around(self.mesh.vertices).max()) ** 3

    def _closed(self) -> manifold3d.Manifold:
        if self._solid is None:
            self._solid, note = _solid(self.mesh)
            self.repaired = f"{self._name}: {note}" if note else ""
        return self._solid


@dataclass(frozen=True, slots=True, eq=False)
class ModelBody(Frozen):
    """Geometry that moves as one: a free body with all below it, or everything that stands still.

    Attributes:
        name: Of the free body, `#7` where body 7 has none; `world` for what stands still.
        parts: What it is seen as, a part per geom, in the frame of the body.
    """

    name: str
    parts: tuple[GeomSolid, ...]

    @property
    def mesh(self) -> TriangleMesh:
        """All it is seen as, in the frame of the body."""
        return joined([part.mesh for part in self.parts])

    @property
    def repaired(self) -> tuple[str, ...]:
        """Geoms whose mesh is no closed solid as it stands, with what was done, e.g. `obj_003: filled`."""
        return tuple(part.repaired for part in self.parts if part.repaired)


def bodies_of_model(model: mujoco.MjModel) -> tuple[tuple[ModelBody, ...], ModelBody]:
    """The free bodies of the model in its order, and all that stands still, as they are seen.

    Seen are the geoms that collide with nothing (a body's visual meshes) and those that collide where nothing of them
    is (`geoms_without_visual`); where a body has none that collide with nothing, all of them.
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


def deepest_overlaps(
    moving: Sequence[ModelBody], poses: Sequence[Pose], still: ModelBody
) -> list[tuple[str, str, float]]:
    """Every pair of things whose solids share volume, with the thickness of what they share [m]."""
    standing = [*zip(moving, poses, strict=True), (still, identity_pose())]
    placed = [(thing.name, [_Placed(part, pose) for part in thing.parts]) for thing, pose in standing]
    found = []
    for i, (name_a, parts_a) in enumerate(placed):
        for name_b, parts_b in placed[i + 1 :]:
            depth = max((_overlap(a, b) for a in parts_a for b in parts_b), default=0.0)
            if depth > 0.0:
                found.append((name_a, name_b, depth))
    return found


class _Placed:
    """A part where its thing is."""

    def __init__(self, part: GeomSolid, pose: Pose) -> None:
        self._part, self._pose = part, pose
        self.points = part.points_at(pose)
        self.low, self.high = aabb(self.points)

    def solid_before(self, normal: Vector3, high: float) -> manifold3d.Manifold:
        """The solid, or one that is the same where `x @ normal < high`."""
        if len(self._part.mesh.faces) > _FEW_FACES and "_whole" not in vars(self) and self._part.is_plain:
            some = overlapping_regions(replace(self._part.mesh, vertices=self.points), normal, high)
            if some is not None and not (solid := as_solid(some)).is_empty():
                return solid
        return self._whole

    @cached_property
    def _whole(self) -> manifold3d.Manifold:
        return self._part.solid_at(self._pose)


def _overlap(a: _Placed, b: _Placed) -> float:
    if (a.low >= b.high).any() or (b.low >= a.high).any():
        return 0.0
    slab = slab_between(a.points, b.points)
    if slab.is_gap:
        return 0.0
    # Of what either cut solid is beyond its end of the slab, nothing meets the other, cut or not.
    regions = (a.solid_before(slab.normal, slab.high) ^ b.solid_before(-slab.normal, -slab.low)).decompose()
    return max((region_thickness(region) for region in regions), default=0.0)


def _thing(model: mujoco.MjModel, data: mujoco.MjData, name: str, root: int, geoms: np.ndarray) -> ModelBody:
    to_root = inverse(_pose(data.xpos[root], data.xmat[root]))
    parts = []
    for geom in _shape_geoms(model, data, geoms):
        shape = geom_shape(model, geom)
        if shape is not None:
            mesh = placed_mesh(shape, compose(to_root, _pose(data.geom_xpos[geom], data.geom_xmat[geom])))
            parts.append(GeomSolid(model.geom(geom).name or name, mesh))
    return ModelBody(name, tuple(parts))


def _shape_geoms(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray) -> list[int]:
    """The geoms that make up the shapes of bodies, each body judged for itself."""
    chosen: list[int] = []
    for root in np.unique(model.body_rootid[model.geom_bodyid[geoms]]):
        own = [int(geom) for geom in geoms if model.body_rootid[model.geom_bodyid[geom]] == root]
        solid = [geom for geom in own if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        drawn = [geom for geom in own if geom not in solid] or own
        chosen += [*drawn, *geoms_without_visual(model, data, drawn, solid)]
    return chosen


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
