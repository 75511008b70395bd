"""Contents of a compiled MuJoCo model by object, for all output formats and for measurements of any MJCF."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Matrix3, Pose, TriangleMesh, Vector3
from tableverse_factory.delivery.formats.model_settings import (
    ContactSettings,
    SolverSettings,
    read_contact_settings,
    read_solver_settings,
)
from tableverse_factory.delivery.formats.model_views import (
    ModelCamera,
    ModelLight,
    read_ambient,
    read_cameras,
    read_lights,
)
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, pose_from_rotation, rotation_matrix
from tableverse_factory.geometry.mesh.hulls import make_hull_mesh
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.mjcf.geom_meshes import make_geom_mesh, name_body
from tableverse_factory.physics.mjcf.scenery import Rgb, make_geom_box, make_geom_plane, read_geom_color, read_geom_mesh
from tableverse_factory.physics.mjcf.undrawn_geoms import find_undrawn_geoms

# Lowercase names of supports, which are never taken for objects
TABLE_NAMES = frozenset({"table", "tabletop", "table_top", "table-top", "ground", "floor", "groundplane", "desk"})
HIDDEN_GROUP = 3  # geoms of this group and above are hidden in MuJoCo's viewer: usually shapes that only collide


@dataclass(frozen=True, slots=True, eq=False)
class VisualMesh(Frozen):
    """Visual mesh in its object's own frame [m], with an sRGB color for meshes without texture."""

    mesh: TriangleMesh
    color: Rgb


@dataclass(frozen=True, slots=True, eq=False)
class ModelObject(Frozen):
    """Object with its attached bodies, in its own frame, which is that of its body."""

    name: str  # of the body; `#7` where body 7 has none
    pose: Pose  # of its own frame in the world
    looks: tuple[VisualMesh, ...]  # visuals in MuJoCo's viewer, or everything where there are none
    unseen: tuple[TriangleMesh, ...]  # colliders that no visual represents, part of the shape all the same
    hulls: tuple[TriangleMesh, ...]  # convex colliders
    contacts: tuple[ContactSettings, ...]  # of each of the hulls
    mass_kg: float
    center: Vector3  # of mass [m]
    inertia: Matrix3  # about the center of mass [kg m²]
    friction: float  # largest sliding friction of the colliders
    spin_roll: tuple[float, float]  # largest torsional and rolling friction of the colliders [m]


@dataclass(frozen=True, slots=True, eq=False)
class ModelContents(Frozen):
    """Objects of a scene, how it is lit and seen, and the solver settings with which it rests."""

    objects: tuple[ModelObject, ...]  # movable ones; in a model without any, every body on the world but the table
    still: tuple[ModelObject, ...]  # usually the table
    lights: tuple[ModelLight, ...]
    ambient: Float64[np.ndarray, "3"]  # light from everywhere; 1 is white
    cameras: tuple[ModelCamera, ...]
    solver: SolverSettings


def read_model_contents(model: mujoco.MjModel, colliders: bool = True) -> ModelContents:
    """Read a model in its initial state; without its colliders, `hulls`, `contacts` and `unseen` are empty."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    roots = [int(root) for root in np.unique(model.body_rootid[model.geom_bodyid])]
    moving = {int(root) for root in np.unique(model.body_rootid[model.jnt_bodyid])}
    chosen = moving or {root for root in roots if root > 0 and not is_table(name_body(model, root))}
    return ModelContents(
        tuple(_read_object(model, data, root, colliders) for root in roots if root in chosen),
        tuple(_read_object(model, data, root, colliders) for root in roots if root not in chosen),
        read_lights(model, data),
        read_ambient(model),
        read_cameras(model, data),
        read_solver_settings(model),
    )


def is_table(name: str) -> bool:
    """Test whether a name is that of a support."""
    return name.strip().lower() in TABLE_NAMES


def _read_object(model: mujoco.MjModel, data: mujoco.MjData, root: int, colliders: bool) -> ModelObject:
    pose = pose_from_rotation(data.xpos[root], data.xmat[root].reshape(3, 3))
    geoms = [int(geom) for geom in np.flatnonzero(model.body_rootid[model.geom_bodyid] == root)]
    solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    seen = _list_visual_geoms(model, geoms)
    looks = [look for geom in seen if (look := _load_visual(model, data, geom, pose))]
    undrawn = find_undrawn_geoms(model, data, seen, solid) if colliders else []
    unseen = [look.mesh for geom in undrawn if (look := _load_visual(model, data, geom, pose))]
    found = [(hull, geom) for geom in solid if colliders and (hull := _compute_hull(model, data, geom, pose))]
    contacts = tuple(read_contact_settings(model, geom) for _, geom in found)
    friction, spin, roll = model.geom_friction[solid].max(axis=0).tolist() if solid else (1.0, 0.0, 0.0)
    properties = _compute_mass_properties(model, data, root, pose)
    shapes = tuple(looks), tuple(unseen), tuple(hull for hull, _ in found)
    return ModelObject(name_body(model, root), pose, *shapes, contacts, *properties, friction, (spin, roll))


def _list_visual_geoms(model: mujoco.MjModel, geoms: Sequence[int]) -> list[int]:
    """List geoms that the viewer shows, colliding or not; of equal meshes at the same place, the first is enough."""
    once: dict[tuple[object, ...], int] = {}
    for geom in [g for g in geoms if model.geom_group[g] < HIDDEN_GROUP] or geoms:
        place = *model.geom_pos[geom], *model.geom_quat[geom], *model.geom_size[geom]
        once.setdefault((model.geom_bodyid[geom], model.geom_type[geom], model.geom_dataid[geom], *place), geom)
    return list(once.values())


def _load_visual(model: mujoco.MjModel, data: mujoco.MjData, geom: int, pose: Pose) -> VisualMesh | None:
    makers = {
        mujoco.mjtGeom.mjGEOM_MESH: read_geom_mesh,
        mujoco.mjtGeom.mjGEOM_BOX: make_geom_box,
        mujoco.mjtGeom.mjGEOM_PLANE: make_geom_plane,
    }
    shape = makers.get(mujoco.mjtGeom(model.geom_type[geom]), make_geom_mesh)(model, geom)
    if shape is None:
        return None
    return VisualMesh(_to_object_frame(shape, data, geom, pose), read_geom_color(model, geom))


def _compute_hull(model: mujoco.MjModel, data: mujoco.MjData, geom: int, pose: Pose) -> TriangleMesh | None:
    """Compute a collider as a convex hull, with primitives as fine polyhedra; None for a plane."""
    shape = None if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE else make_geom_mesh(model, geom)
    if shape is None:
        return None
    hull = make_hull_mesh(_to_object_frame(shape, data, geom, pose).vertices)
    return hull if len(hull.faces) else None


def _to_object_frame(mesh: TriangleMesh, data: mujoco.MjData, geom: int, pose: Pose) -> TriangleMesh:
    geom_pose = pose_from_rotation(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3))
    return place_mesh(mesh, compose_poses(invert_pose(pose), geom_pose))


def _compute_mass_properties(
    model: mujoco.MjModel, data: mujoco.MjData, root: int, pose: Pose
) -> tuple[float, Vector3, Matrix3]:
    """Compute mass, center and inertia of a body with all attached bodies, in the object's own frame."""
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
