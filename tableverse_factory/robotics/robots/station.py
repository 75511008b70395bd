"""Exported scene with an arm: one compiled model whose arm base moves without recompiling."""

from collections.abc import Mapping
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Int64

from schemas.geometry import Points, Pose
from schemas.trajectories import JointVector, Numbers
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.math.planes import Points2
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.relations.relations import compute_outline
from tableverse_factory.physics.mjcf.file_check import check_references
from tableverse_factory.physics.mjcf.geom_meshes import make_geom_mesh
from tableverse_factory.physics.simulate.at_rest import find_free_bodies, make_quiet_data
from tableverse_factory.robotics.robots.arm import Arm

PREFIX = "robot/"  # prefix of the arm's names in the scene's model
PEDESTAL_HEIGHT_M = 0.75
# Just below the base's foot: for an arm on the table, the pedestal's top is hidden inside the slab
PEDESTAL_TOP_M = -0.002
PEDESTAL_SHARE = 0.75  # radius of the pedestal over that of the foot's circle
_SIZE_FIELDS = ("memory", "nstack", "njmax", "nconmax", "nuserdata")
_PEDESTAL_RGBA = (0.32, 0.34, 0.37, 1.0)
_COLLISION_GROUP, _VISUAL_GROUP = 3, 2
Ids = Int64[np.ndarray, "n"]


class Station:
    """Scene and arm in one model, which only `place_base` changes.

    `…_qpos` and `…_dof` are addresses in qpos and qvel, of joints or of an object's pose and velocity; actuators,
    bodies, geoms and sites are given by their MuJoCo ids, objects in the order of the model. `finger_geoms` may touch
    the gripped object, `arm_bodies` include the base, and `base_body` carries the arm and its pedestal.
    """

    def __init__(
        self, files: Mapping[str, bytes], arm: Arm, base: Pose | None = None, *, visuals: bool = False
    ) -> None:
        """Compile exported files (`scene.xml`, `assets/…`, of any origin) with the arm below a body `robot/pedestal`.

        `base` is in the table frame, by default 0.55 m in front of the origin. Without `visuals` the model simulates
        the same and compiles faster.
        """
        self.arm = arm
        self.model = _compile_station(files, arm, visuals)
        model = self.model
        joints = [model.joint(PREFIX + name).id for name in arm.joint_names]
        fingers = [model.joint(PREFIX + name).id for name in arm.finger_joints]
        qpos, dof = model.jnt_qposadr.astype(int), model.jnt_dofadr.astype(int)
        self.joint_qpos, self.joint_dof = qpos[joints], dof[joints]
        self.finger_qpos, self.finger_dof = qpos[fingers], dof[fingers]
        self.joint_actuators: Ids = np.array([model.actuator(PREFIX + name).id for name in arm.actuator_names])
        self.gripper_actuator = int(model.actuator(PREFIX + arm.gripper_actuator).id)
        self.finger_geoms: Ids = np.array([model.geom(PREFIX + name).id for name in arm.finger_geoms])
        self.tcp_site = int(model.site(PREFIX + arm.tcp_site).id)
        self.base_body = int(model.body(f"{PREFIX}pedestal").id)
        self.arm_bodies: Ids = np.array(find_subtree(model, self.base_body))
        free = find_free_bodies(model)
        self.object_ids = tuple(model.body(body).name for body in free)
        self.object_bodies = dict(zip(self.object_ids, free, strict=True))
        self.object_qpos = {name: int(qpos[model.body_jntadr[b]]) for name, b in self.object_bodies.items()}
        self.object_dof = {name: int(model.body_dofadr[b]) for name, b in self.object_bodies.items()}
        self.base = base or Pose(np.array([0.0, -0.55, 0.0]), np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))
        self.place_base(self.base)

    @property
    def pedestal_radius_m(self) -> float:
        """Radius of the column below the base [m]."""
        return PEDESTAL_SHARE * self.arm.base_radius_m

    @cached_property
    def outlines(self) -> tuple[Points2, ...]:
        """Convex outline of each object as exported, seen from above, counter-clockwise. Each of shape (n, 2) [m]."""
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        return tuple(
            compute_outline(_collect_vertices(self.model, data, body)[:, :2]) for body in self.object_bodies.values()
        )

    def place_base(self, base: Pose) -> None:
        """Move the arm's root body to a pose in the table frame. Existing data become stale: make fresh ones."""
        self.base = Pose(np.array(base.position), normalize_quaternion(base.quaternion_wxyz))
        self.model.body_pos[self.base_body] = self.base.position
        self.model.body_quat[self.base_body] = self.base.quaternion_wxyz

    def data(self) -> mujoco.MjData:
        """Make fresh data: objects as exported, the arm held at home with open fingers."""
        data = make_quiet_data(self.model)
        self.set_arm(data, self.arm.home, self.arm.max_opening_m)
        data.ctrl[self.joint_actuators] = self.arm.home
        data.ctrl[self.gripper_actuator] = self.arm.gripper_command(self.arm.max_opening_m)
        mujoco.mj_forward(self.model, data)
        return data

    def set_arm(self, data: mujoco.MjData, joints: JointVector, opening_m: float) -> None:
        """Set positions of the arm's joints and fingers; derived quantities are not recomputed."""
        data.qpos[self.joint_qpos] = joints
        data.qpos[self.finger_qpos] = self.arm.finger_positions(opening_m)

    def control(self, data: mujoco.MjData, command: Numbers) -> None:
        """Set the servos' targets: joints [rad], then the opening [m]. Shape of `command`: (j + 1,)."""
        data.ctrl[self.joint_actuators] = command[:-1]
        data.ctrl[self.gripper_actuator] = self.arm.gripper_command(float(command[-1]))

    def opening(self, data: mujoco.MjData) -> float:
        """Compute the distance between the fingertips from the finger joints [m]."""
        return float(self.arm.compute_openings(data.qpos[self.finger_qpos]))


def _collect_vertices(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> Points:
    """Collect world vertices of all geoms of a free body, or its origin if it has none. Shape (n, 3) [m]."""
    points = [data.xpos[body][None].copy()]
    for geom in np.flatnonzero(model.body_rootid[model.geom_bodyid] == body):
        shape = make_geom_mesh(model, int(geom))
        if shape is not None:
            points.append(shape.vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return np.concatenate(points[1:] or points)


def build_station_spec(files: Mapping[str, bytes], arm: Arm, visuals: bool = False) -> mujoco.MjSpec:
    """Build the uncompiled specification of scene and arm; the pedestal `robot/pedestal` is at the origin."""
    if "scene.xml" not in files:
        raise InputError("there is no scene.xml", "bad_mjcf")
    check_references(files["scene.xml"], files.keys())
    assets = {name: data for name, data in files.items() if name.startswith("assets/")}
    try:
        spec = mujoco.MjSpec.from_string(files["scene.xml"].decode(), assets=assets)
        if not visuals:
            delete_visual_meshes(spec)
            spec.compiler.discardvisual = True
        _attach_arm(spec, arm)
        return spec
    except (ValueError, UnicodeDecodeError) as error:
        raise _load_error(arm, error) from error


def _compile_station(files: Mapping[str, bytes], arm: Arm, visuals: bool) -> mujoco.MjModel:
    spec = build_station_spec(files, arm, visuals)
    try:
        return spec.compile()
    except ValueError as error:
        raise _load_error(arm, error) from error


def _load_error(arm: Arm, error: Exception) -> InputError:
    message = sanitize_line(str(error), 500)
    return InputError(f"scene.xml with the arm {arm.name!r} does not load: {message}", "bad_mjcf")


def _attach_arm(spec: mujoco.MjSpec, arm: Arm) -> None:
    pedestal = spec.worldbody.add_body(name=f"{PREFIX}pedestal")
    for name, group, touches in (("pedestal", _COLLISION_GROUP, 1), ("pedestal_look", _VISUAL_GROUP, 0)):
        column = pedestal.add_geom(name=f"{PREFIX}{name}", type=mujoco.mjtGeom.mjGEOM_CYLINDER, group=group)
        column.pos = [0.0, 0.0, PEDESTAL_TOP_M - PEDESTAL_HEIGHT_M / 2]
        column.size = [PEDESTAL_SHARE * arm.base_radius_m, PEDESTAL_HEIGHT_M / 2, 0.0]
        column.rgba, column.contype, column.conaffinity = _PEDESTAL_RGBA, touches, touches
    child = arm.spec()
    copy_simulation_settings(child, spec)
    pedestal.add_frame().attach_body(child.body(arm.base_body), PREFIX, "")


def copy_simulation_settings(child: mujoco.MjSpec, scene: mujoco.MjSpec) -> None:
    """Copy the scene's simulation settings to a specification: the scene's apply, and MuJoCo warns of others."""
    parts = [(getattr(child.visual, name), getattr(scene.visual, name)) for name in _fields(child.visual)]
    for own, theirs in ((child.option, scene.option), *parts):
        for name in _fields(own):
            setattr(own, name, getattr(theirs, name))
    for name in _SIZE_FIELDS:
        setattr(child, name, getattr(scene, name))


def _fields(settings: object) -> list[str]:
    return [name for name in dir(settings) if not name.startswith("_")]


def delete_visual_meshes(spec: mujoco.MjSpec) -> None:
    """Delete meshes that do not collide, which the compiler would read before discarding them."""
    for geom in spec.geoms:
        if geom.contype == 0 and geom.conaffinity == 0 and geom.meshname:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in spec.meshes:
        if mesh.name not in used:
            spec.delete(mesh)


def find_subtree(model: mujoco.MjModel, root: int) -> list[int]:
    """List a body and its descendants, ascending."""
    found = {root}
    for body in range(root + 1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return sorted(found)
