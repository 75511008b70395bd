"""What a compiled MuJoCo model holds, object by object: what is seen, what collides, what it weighs.

One reading of a scene for every format it is written in, and for everything that is measured on anybody's MJCF.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Frozen, Matrix3, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.transforms import compose, inverse, pose_from_matrix, rotation_matrix
from tableverse_factory.geometry.mesh.hulls import hull_mesh
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.physics.mjcf.drawables import Rgb, geom_box, geom_color, geom_mesh
from tableverse_factory.physics.mjcf.hidden_geoms import geoms_without_visual
from tableverse_factory.physics.simulate.model_solids import body_name, geom_shape

TABLE_NAMES = frozenset({"table", "tabletop", "table_top", "table-top", "ground", "floor", "groundplane", "desk"})
"""Names, in small letters, of what objects stand on: it is never taken for one of them."""

HIDDEN_GROUP = 3
"""Geoms of this group and above are hidden in MuJoCo's viewer: there shapes lie that only collide."""

UNBOUNDED_PLANE_M = 1.0
"""Half the side that a plane without an end is drawn with [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class VisualMesh(Frozen):
    """Something seen: a mesh with its texture, or in one colour.

    Attributes:
        mesh: In the object's own frame [m].
        color: sRGB where the mesh has no texture.
    """

    mesh: TriangleMesh
    color: Rgb


@dataclass(frozen=True, slots=True, eq=False)
class ModelObject(Frozen):
    """One object, in its own frame, which is that of its body.

    Attributes:
        name: Of the body; `#7` where body 7 has none.
        pose: Its own frame in the world.
        looks: What MuJoCo's viewer shows of it; everything, where that is nothing.
        unseen: What collides where nothing of the looks stands for it: part of the shape all the same.
        hulls: Convex shapes that collide.
        mass_kg: With all that hangs on it.
        center: Centre of mass [m].
        inertia: About the centre of mass [kg m²]. Shape (3, 3).
        friction: Sliding friction of the shapes that collide, the largest.
    """

    name: str
    pose: Pose
    looks: tuple[VisualMesh, ...]
    unseen: tuple[TriangleMesh, ...]
    hulls: tuple[TriangleMesh, ...]
    mass_kg: float
    center: Vector3
    inertia: Matrix3
    friction: float


@dataclass(frozen=True, slots=True)
class ModelContents:
    """A scene.

    Attributes:
        objects: What can move; in a model in which nothing can, every body on the world but the table.
        still: What stands still: the table, as a rule.
    """

    objects: tuple[ModelObject, ...]
    still: tuple[ModelObject, ...]


def contents_of(model: mujoco.MjModel) -> ModelContents:
    """Reads a model in its initial state."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    roots = [int(root) for root in np.unique(model.body_rootid[model.geom_bodyid])]
    moving = {int(root) for root in np.unique(model.body_rootid[model.jnt_bodyid])}
    chosen = moving or {root for root in roots if root > 0 and not is_table(body_name(model, root))}
    return ModelContents(
        tuple(_content(model, data, root) for root in roots if root in chosen),
        tuple(_content(model, data, root) for root in roots if root not in chosen),
    )


def is_table(name: str) -> bool:
    """Whether a name says that this is what the others stand on."""
    return name.strip().lower() in TABLE_NAMES


def _content(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> ModelObject:
    pose = _pose(data.xpos[root], data.xmat[root])
    geoms = [int(geom) for geom in np.flatnonzero(model.body_rootid[model.geom_bodyid] == root)]
    solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    seen = _seen(model, geoms)
    looks = [_look(model, data, geom, pose) for geom in seen]
    unseen = (_look(model, data, geom, pose) for geom in geoms_without_visual(model, data, seen, solid))
    hulls = [hull for hull in (_hull(model, data, geom, pose) for geom in solid) if hull is not None]
    mass, center, inertia = _mass(model, data, root, pose)
    friction = float(model.geom_friction[solid, 0].max()) if solid else 1.0
    looks_there = tuple(look for look in looks if look is not None)
    shape = tuple(look.mesh for look in unseen if look is not None)
    return ModelObject(body_name(model, root), pose, looks_there, shape, tuple(hulls), mass, center, inertia, friction)


def _seen(model: mujoco.MjModel, geoms: Sequence[int]) -> list[int]:
    """What the viewer shows. Whether a geom collides says nothing of that: a decal beside a solid is not all there is.

    Of geoms that are the same mesh at the same place, one to be seen and one to collide, the first is enough.
    """
    once: dict[tuple[object, ...], int] = {}
    for geom in [g for g in geoms if model.geom_group[g] < HIDDEN_GROUP] or geoms:
        place = *model.geom_pos[geom], *model.geom_quat[geom], *model.geom_size[geom]
        once.setdefault((model.geom_bodyid[geom], model.geom_type[geom], model.geom_dataid[geom], *place), geom)
    return list(once.values())


def _look(model: mujoco.MjModel, data: mujoco.MjData, geom: int, pose: Pose) -> VisualMesh | None:
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    shape: TriangleMesh | None
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        shape = geom_mesh(model, geom)
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape = geom_box(model, geom)
    elif kind == mujoco.mjtGeom.mjGEOM_PLANE:
        shape = _sheet(size)
    else:
        shape = geom_shape(model, geom)
    return None if shape is None else VisualMesh(_in_frame(shape, data, geom, pose), geom_color(model, geom))


def _sheet(size: np.ndarray) -> TriangleMesh:
    x, y = (float(half) if half > 0.0 else UNBOUNDED_PLANE_M for half in size[:2])
    corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


def _hull(model: mujoco.MjModel, data: mujoco.MjData, geom: int, pose: Pose) -> TriangleMesh | None:
    """What MuJoCo collides with: the convex hull of a mesh, a primitive as a fine polyhedron; None for a plane."""
    shape = None if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE else geom_shape(model, geom)
    if shape is None:
        return None
    hull = hull_mesh(_in_frame(shape, data, geom, pose).vertices)
    return hull if len(hull.faces) else None


def _in_frame(mesh: TriangleMesh, data: mujoco.MjData, geom: int, pose: Pose) -> TriangleMesh:
    """A geom's mesh in the frame of the object."""
    return placed_mesh(mesh, compose(inverse(pose), _pose(data.geom_xpos[geom], data.geom_xmat[geom])))


def _mass(model: mujoco.MjModel, data: mujoco.MjData, root: int, pose: Pose) -> tuple[float, Vector3, Matrix3]:
    """Mass, centre and inertia of a body and all that hangs on it, in the object's own frame."""
    bodies = [int(b) for b in np.flatnonzero(model.body_rootid == root)] if root else []
    mass = float(model.body_mass[bodies].sum()) if bodies else 0.0
    if mass <= 0.0:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    center = model.body_mass[bodies] @ data.xipos[bodies] / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        axes = data.ximat[body].reshape(3, 3)
        arm = data.xipos[body] - center
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia += model.body_mass[body] * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    turn = rotation_matrix(pose.quaternion_wxyz)
    local: Vector3 = turn.T @ (center - pose.position)
    return mass, local, turn.T @ inertia @ turn


def _pose(position: np.ndarray, matrix: np.ndarray) -> Pose:
    homogeneous = np.eye(4)
    homogeneous[:3, :3], homogeneous[:3, 3] = matrix.reshape(3, 3), position
    return pose_from_matrix(homogeneous)
