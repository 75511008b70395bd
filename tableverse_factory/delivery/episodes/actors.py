"""Meshes of a recorded scene: what moves (arm, carried and pushed objects), and what stands still."""

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import trimesh

from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.incremental_renderer import PaintedMeshes
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    invert_pose,
    normalize_quaternion,
    transform_points,
)
from tableverse_factory.physics.mjcf.scenery import load_scenery, make_box_mesh, read_geom_color, read_geom_mesh
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.execution.poses import pose_from_row
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.station import PEDESTAL_HEIGHT_M, PEDESTAL_SHARE, PEDESTAL_TOP_M

_VISUAL_GROUP = 2
PEDESTAL_COLOR = (82, 87, 94)
_SECTIONS = 24  # sides of round primitives


@dataclass(frozen=True, slots=True, eq=False)
class RenderScene(Frozen):
    """Meshes to render."""

    still: PaintedMeshes  # in the table frame
    moving: PaintedMeshes  # each in its own frame: objects first, then the arm's
    names: tuple[str, ...]  # object id of each of the first of `moving`
    still_names: tuple[str, ...]  # of each of `still` but the last two, which are the table and the pedestal


class ArmMeshes:
    """Arm as one mesh per body, with their poses as functions of the joints."""

    def __init__(self, arm: Arm) -> None:
        try:
            self._model = arm.spec().compile()
        except ValueError as error:
            raise InputError(f"the arm {arm.name} does not compile: {error}"[:300], "bad_arm") from None
        self._data = mujoco.MjData(self._model)
        self._home = np.array([*arm.home, *arm.finger_positions(arm.max_opening_m)])
        joints = (*arm.joint_names, *arm.finger_joints)
        self._addresses = [int(self._model.joint(name).qposadr[0]) for name in joints]
        shown = _list_visual_geoms(self._model)
        self._bodies = sorted({int(self._model.geom_bodyid[geom]) for geom in shown})
        self._column = _make_cylinder(PEDESTAL_SHARE * arm.base_radius_m, PEDESTAL_HEIGHT_M / 2)
        self.meshes = tuple(_merge_body_mesh(self._model, body, shown) for body in self._bodies)

    def check_recording(self, recording: Recording) -> None:
        """Check that the recorded joints are those of this arm."""
        if (recorded := recording.qpos.shape[1]) != (known := len(self._addresses)):
            raise InputError(f"{recorded} positions are recorded, and {recording.robot} has {known}", "bad_arrays")

    def pedestal(self, base: Pose) -> TriangleMesh:
        """Return the base's pedestal in the table frame; on the table, the slab hides most of it."""
        middle = np.array([0.0, 0.0, PEDESTAL_TOP_M - PEDESTAL_HEIGHT_M / 2])
        return TriangleMesh(transform_points(base, self._column.vertices + middle), self._column.faces)

    def poses(self, positions: np.ndarray, base: Pose) -> list[Pose]:
        """Compute the meshes' poses in the table frame from positions of joints and fingers. Shape (j + f,)."""
        self._data.qpos[self._addresses] = positions
        mujoco.mj_kinematics(self._model, self._data)
        return [compose_poses(base, _read_pose(self._data, body)) for body in self._bodies]

    def home_poses(self, base: Pose) -> list[Pose]:
        """Compute the meshes' poses with the arm at home and its fingers open."""
        return self.poses(self._home, base)


def build_recorded_scene(scene: Scene, x_id: str, figure: ArmMeshes, recording: Recording) -> RenderScene:
    """Split the scene's meshes into recorded as moved and still, and add the arm on its pedestal."""
    return build_render_scene(scene, {x_id, *recording.moved_ids}, figure, recording.base)


def build_render_scene(scene: Scene, moved: AbstractSet[str], figure: ArmMeshes, base: Pose) -> RenderScene:
    """Split the scene's meshes into `moved` and still objects, and add the arm with its base in the table frame."""
    model = scene.model()
    scenery = load_scenery(model)
    if absent := sorted(moved - set(scenery.names)):
        raise InputError(f"scene {scene.scene_id} has no object {absent[0][:80]!r} to move", "no_such_object")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = (*scenery.names, *[""] * (len(scenery.parts) - len(scenery.names)))
    still = [index for index, name in enumerate(names) if name not in moved]
    taken = [index for index, name in enumerate(names) if name in moved]
    meshes = []
    for k in taken:
        to_object = invert_pose(_read_pose(data, model.body(names[k]).id))
        meshes.append(replace(scenery.parts[k], vertices=transform_points(to_object, scenery.parts[k].vertices)))
    return RenderScene(
        PaintedMeshes(
            (*(scenery.parts[k] for k in still), figure.pedestal(base)),
            (*(scenery.colors[k] for k in still), PEDESTAL_COLOR),
        ),
        PaintedMeshes((*meshes, *figure.meshes), (*(scenery.colors[k] for k in taken), *[None] * len(figure.meshes))),
        tuple(names[k] for k in taken),
        tuple(names[k] for k in still if names[k]),
    )


def iterate_poses(
    cast: RenderScene, figure: ArmMeshes, recording: Recording, samples: Sequence[int]
) -> Iterator[list[Pose]]:
    """Iterate poses of everything that moves, at some samples of a recording."""
    figure.check_recording(recording)
    others = [recording.poses_of(name) for name in cast.names]
    ways = [recording.object_pose if way is None else way for way in others]  # X is none of the others
    for sample in samples:
        arm = figure.poses(recording.qpos[sample].astype(np.float64), recording.base)
        yield [pose_from_row(way[sample]) for way in ways] + arm


def _read_pose(data: mujoco.MjData, body: int) -> Pose:
    return Pose(np.array(data.xpos[body]), normalize_quaternion(np.array(data.xquat[body])))


def _list_visual_geoms(model: mujoco.MjModel) -> list[int]:
    """List visual geoms, or all where there are none."""
    solid = [geom for geom in range(model.ngeom) if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE]
    return [geom for geom in solid if model.geom_group[geom] == _VISUAL_GROUP] or solid


def _merge_body_mesh(model: mujoco.MjModel, body: int, shown: Sequence[int]) -> TriangleMesh:
    """Merge all geoms of a body into one mesh in its frame, each in its own color."""
    vertices, faces, colors, first = [], [], [], 0
    for geom in (geom for geom in shown if model.geom_bodyid[geom] == body):
        mesh = _load_geom_mesh(model, geom)
        quaternion = normalize_quaternion(np.array(model.geom_quat[geom]))
        vertices.append(transform_points(Pose(np.array(model.geom_pos[geom]), quaternion), mesh.vertices))
        faces.append(mesh.faces + first)
        colors.append(np.tile(np.array(read_geom_color(model, geom), dtype=np.uint8), (len(mesh.vertices), 1)))
        first += len(mesh.vertices)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.concatenate(colors))


def _load_geom_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), np.array(model.geom_size[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return read_geom_mesh(model, geom)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return make_box_mesh(size)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        solid = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=[_SECTIONS, _SECTIONS // 2])
        solid.apply_translation([0.0, 0.0, -solid.bounds.mean(axis=0)[2]])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return _make_cylinder(size[0], size[1])
    else:
        solid = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
        solid.apply_scale(size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0])
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces, dtype=np.int32))


def _make_cylinder(radius: float, half_height: float) -> TriangleMesh:
    solid = trimesh.creation.cylinder(height=2 * half_height, radius=radius, sections=_SECTIONS)
    return TriangleMesh(np.array(solid.vertices), np.array(solid.faces, dtype=np.int32))
