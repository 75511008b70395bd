"""Bodies of a compiled MuJoCo model as solids: the free bodies and the static geometry. Works on any MJCF."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import manifold3d
import mujoco
import numpy as np

from schemas.geometry import Frozen, Points, Pose, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.collision.broad_phase import crop_to_half_space, find_separating_slab
from tableverse_factory.geometry.collision.penetration import measure_thickness
from tableverse_factory.geometry.math.aabb import aabb, aabb_size
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    identity_pose,
    invert_pose,
    matrix_from_pose,
    pose_from_rotation,
    transform_points,
)
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes, place_mesh
from tableverse_factory.geometry.mesh.repair import MIN_FILL_SHARE, make_closed_solid, mesh_to_solid
from tableverse_factory.geometry.mesh.shells import is_one_shell
from tableverse_factory.physics.mjcf.geom_meshes import make_geom_mesh, name_body
from tableverse_factory.physics.mjcf.inertia import is_closed
from tableverse_factory.physics.mjcf.undrawn_geoms import find_undrawn_geoms
from tableverse_factory.physics.simulate.at_rest import find_free_bodies

_MIN_CROPPED_FACES = 500  # of fewer the whole solid is made


class GeomSolid:
    """One geom in the frame of its body.

    A closed mesh is made a solid only when its box meets another's, and only as far as that other can reach, as making
    solids is the most expensive step. `repaired` is empty, or how another mesh was closed, e.g. `obj_003: filled`.
    """

    def __init__(self, name: str, mesh: TriangleMesh) -> None:
        self._name, self.mesh, self.repaired = name, mesh, ""
        self._solid: manifold3d.Manifold | None = None
        if not is_closed(mesh) or self._is_flat:
            self._closed()

    def points_at(self, pose: Pose) -> Points:
        """Points whose hull holds the solid, with its body at this pose."""
        if self.repaired:
            return self.solid_at(pose).to_mesh64().vert_properties[:, :3].astype(np.float64)
        return transform_points(pose, self.mesh.vertices)

    def solid_at(self, pose: Pose) -> manifold3d.Manifold:
        """The solid with its body at this pose."""
        return self._closed().transform(matrix_from_pose(pose)[:3])

    @cached_property
    def is_plain(self) -> bool:
        """Whether the mesh bounds a solid by one surface, without repair."""
        return self._solid is None and is_one_shell(self.mesh) and compute_signed_volume(self.mesh) > 0.0

    @property
    def _is_flat(self) -> bool:
        """Whether it encloses almost nothing: repair then changes its extent."""
        return abs(compute_signed_volume(self.mesh)) <= MIN_FILL_SHARE * float(aabb_size(self.mesh.vertices).max()) ** 3

    def _closed(self) -> manifold3d.Manifold:
        if self._solid is None:
            self._solid, note = _close_mesh(self.mesh)
            self.repaired = f"{self._name}: {note}" if note else ""
        return self._solid


@dataclass(frozen=True, slots=True, eq=False)
class ModelBody(Frozen):
    """Geometry that moves as one, in the frame of the body: a free body with its children, or all static (`world`)."""

    name: str
    parts: tuple[GeomSolid, ...]

    @property
    def mesh(self) -> TriangleMesh:
        """The visible shape, in the frame of the body."""
        return concatenate_meshes([part.mesh for part in self.parts])

    @property
    def repaired(self) -> tuple[str, ...]:
        """Geoms whose mesh was repaired, and how, e.g. `obj_003: filled`."""
        return tuple(part.repaired for part in self.parts if part.repaired)


def load_bodies(model: mujoco.MjModel) -> tuple[tuple[ModelBody, ...], ModelBody]:
    """Load the free bodies of the model in its order, and the static geometry, with their visible shapes.

    Visible are the geoms that do not collide (a body's visual meshes) and colliding ones that no such geom represents
    (`find_undrawn_geoms`); where all geoms of a body collide, all of them.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    free = find_free_bodies(model)
    roots = model.body_rootid[model.geom_bodyid]
    own = ((name_body(model, root), root, np.flatnonzero(roots == root)) for root in free)
    moving = tuple(_load_body(model, data, *body) for body in own)
    return moving, _load_body(model, data, "world", 0, np.flatnonzero(~np.isin(roots, free)))


def find_deepest_overlaps(
    moving: Sequence[ModelBody], poses: Sequence[Pose], still: ModelBody
) -> list[tuple[str, str, float]]:
    """Find every pair of bodies whose solids share volume, with the thickness of the shared volume [m]."""
    standing = [*zip(moving, poses, strict=True), (still, identity_pose())]
    placed = [(body.name, [_PosedSolid(part, pose) for part in body.parts]) for body, pose in standing]
    found = []
    for i, (name_a, parts_a) in enumerate(placed):
        for name_b, parts_b in placed[i + 1 :]:
            depth = max((_measure_overlap(a, b) for a in parts_a for b in parts_b), default=0.0)
            if depth > 0.0:
                found.append((name_a, name_b, depth))
    return found


class _PosedSolid:
    """A part with its body at a pose."""

    def __init__(self, part: GeomSolid, pose: Pose) -> None:
        self._part, self._pose = part, pose
        self.points = part.points_at(pose)
        self.low, self.high = aabb(self.points)

    def solid_before(self, normal: Vector3, high: float) -> manifold3d.Manifold:
        """The solid, or one that equals it where `x @ normal < high`."""
        if len(self._part.mesh.faces) > _MIN_CROPPED_FACES and "_whole" not in vars(self) and self._part.is_plain:
            some = crop_to_half_space(replace(self._part.mesh, vertices=self.points), normal, high)
            if some is not None and not (solid := mesh_to_solid(some)).is_empty():
                return solid
        return self._whole

    @cached_property
    def _whole(self) -> manifold3d.Manifold:
        return self._part.solid_at(self._pose)


def _measure_overlap(a: _PosedSolid, b: _PosedSolid) -> float:
    if (a.low >= b.high).any() or (b.low >= a.high).any():
        return 0.0
    slab = find_separating_slab(a.points, b.points)
    if slab.is_gap:
        return 0.0
    # Beyond its end of the slab neither solid meets the other, cropped or not.
    regions = (a.solid_before(slab.normal, slab.high) ^ b.solid_before(-slab.normal, -slab.low)).decompose()
    return max((measure_thickness(region) for region in regions), default=0.0)


def _load_body(model: mujoco.MjModel, data: mujoco.MjData, name: str, root: int, geoms: np.ndarray) -> ModelBody:
    to_root = invert_pose(pose_from_rotation(data.xpos[root], data.xmat[root].reshape(3, 3)))
    parts = []
    for geom in _select_shape_geoms(model, data, geoms):
        shape = make_geom_mesh(model, geom)
        if shape is not None:
            pose = pose_from_rotation(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3))
            mesh = place_mesh(shape, compose_poses(to_root, pose))
            parts.append(GeomSolid(model.geom(geom).name or name, mesh))
    return ModelBody(name, tuple(parts))


def _select_shape_geoms(model: mujoco.MjModel, data: mujoco.MjData, geoms: np.ndarray) -> list[int]:
    """Select the geoms that make up the visible shapes of bodies."""
    chosen: list[int] = []
    for root in np.unique(model.body_rootid[model.geom_bodyid[geoms]]):
        own = [int(geom) for geom in geoms if model.body_rootid[model.geom_bodyid[geom]] == root]
        solid = [geom for geom in own if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        drawn = [geom for geom in own if geom not in solid] or own
        chosen += [*drawn, *find_undrawn_geoms(model, data, drawn, solid)]
    return chosen


def _close_mesh(mesh: TriangleMesh) -> tuple[manifold3d.Manifold, str]:
    """Make a solid of a mesh and name the repair: its convex hull (`hull`) where no other helps."""
    try:
        return make_closed_solid(mesh)
    except GeometryError:
        return manifold3d.Manifold.hull_points(mesh.vertices.copy()), "hull"
