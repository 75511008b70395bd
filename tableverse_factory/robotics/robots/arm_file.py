"""Arm from an MJCF file: required parts are checked, missing figures are measured.

The file describes one arm on one body of the world: hinges with limits up to a site `tcp`, a position actuator each,
and two sliding fingers with one more actuator (docs/trajectories.md, "Your own arm"). Nothing outside its folder is
read.
"""

from pathlib import Path

import mujoco
import numpy as np

from schemas.geometry import Vector3
from schemas.trajectories import JointVector
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.physics.mjcf.file_check import check_files
from tableverse_factory.physics.mjcf.geom_meshes import make_geom_mesh
from tableverse_factory.physics.simulate.at_rest import make_quiet_data
from tableverse_factory.robotics.robots.arm import Arm, list_bodies_between
from tableverse_factory.robotics.robots.gripper import measure_gripper, robot_error

TCP_SITE, HOME_KEY = "tcp", "home"
# Gentle defaults for files without a `numeric` of that name [rad/s], [rad/s²], [m/s]
MAX_VELOCITY, MAX_ACCELERATION, MAX_OPENING_SPEED = 1.5, 5.0, 0.1
_MIN_BASE_RADIUS_M, _FOOT_HEIGHT_M = 0.08, 0.15
_HINGE, _FREE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE


def load_arm_file(path: Path, name: str, tcp: tuple[str, Vector3] | None = None) -> Arm:
    """Load an arm, called `name` in rows and arrays, from an MJCF file.

    `tcp` is a body and the position in its frame [m] at which to add a site `tcp`, for a known file that has none.
    """
    spec, model = _load_spec(path, tcp)
    try:
        return _build_arm(spec, model, name)
    except InputError as error:
        raise InputError(f"{path.name}: {error}", error.reason) from None


def _load_spec(path: Path, tcp: tuple[str, Vector3] | None) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    if not path.is_file():
        raise InputError(f"{sanitize_line(str(path), 200)!r} is no file: give the MJCF of an arm", "bad_robot")
    try:
        check_files(path, path.parent)
        spec = mujoco.MjSpec.from_file(str(path))
        if tcp is not None and spec.site(TCP_SITE) is None:
            spec.body(tcp[0]).add_site(name=TCP_SITE, pos=tcp[1])
        for items in (spec.geoms, spec.bodies):
            for index, item in enumerate(items):
                item.name = item.name or f"unnamed_{index}"
        return spec, spec.compile()
    except InputError as error:
        raise InputError(f"{path.name}: {error}", error.reason) from None
    except (ValueError, AttributeError) as error:
        message = f"{path.name}: MuJoCo does not load it: {sanitize_line(str(error), 400)}"
        raise InputError(message, "bad_mjcf") from None


def _build_arm(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> Arm:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, TCP_SITE)
    if site < 0:
        raise robot_error(f"there is no site {TCP_SITE!r}: add one between the fingertips, z out of the hand, y across")
    bodies = list_bodies_between(model, 0, int(model.site_bodyid[site]))
    if not bodies:
        raise robot_error(f"the site {TCP_SITE!r} stands in the world: put it into the hand")
    first, count = model.body_jntadr, model.body_jntnum
    joints = [j for body in bodies for j in range(first[body], first[body] + count[body])]
    _check_chain(model, bodies[0], joints)
    servos = [_find_servo(model, joint) for joint in joints]
    gripper_actuator = _find_gripper_actuator(model, servos)
    home = _read_home(model)
    lower, upper = _compute_limits(model, joints, servos)
    at_home = home[model.jnt_qposadr[joints]]
    if ((at_home < lower) | (at_home > upper)).any():
        raise robot_error(f"the keyframe {HOME_KEY!r} is outside the joints' limits: {at_home.round(4).tolist()}")
    gripper = measure_gripper(model, site, joints, gripper_actuator, home)
    _prepare_for_attachment(spec, model, joints[0], home)
    return Arm(
        name=name,
        template=spec,
        base_body=_require_name(model.body(bodies[0]), "body of the base"),
        joint_names=tuple(_require_name(model.joint(joint), "joint") for joint in joints),
        actuator_names=tuple(_require_name(model.actuator(servo), "actuator") for servo in servos),
        gripper_actuator=_require_name(model.actuator(gripper_actuator), "actuator of the gripper"),
        tcp_site=TCP_SITE,
        home=at_home,
        lower=lower,
        upper=upper,
        max_velocity=_read_numeric(model, "max_velocity", len(joints), MAX_VELOCITY),
        max_acceleration=_read_numeric(model, "max_acceleration", len(joints), MAX_ACCELERATION),
        max_torque=np.array([_read_max_torque(model, j, a) for j, a in zip(joints, servos, strict=True)]),
        max_opening_speed=float(_read_numeric(model, "max_opening_speed", 1, MAX_OPENING_SPEED)[0]),
        base_radius_m=_measure_base_radius(model, bodies[0]),
        gripper_control=gripper.control,
        finger_joints=tuple(_require_name(model.joint(joint), "joint of a finger") for joint in gripper.joints),
        finger_open=gripper.opened,
        finger_closed=gripper.closed,
        finger_geoms=tuple(model.geom(geom).name for geom in gripper.geoms),
        max_opening_m=gripper.max_opening_m,
        shape=gripper.shape,
    )


def _prepare_for_attachment(spec: mujoco.MjSpec, model: mujoco.MjModel, first_joint: int, home: JointVector) -> None:
    """Compensate gravity, drop keyframes, and exclude contacts between the base and the first link."""
    for key in spec.keys:
        spec.delete(key)
    for body in spec.bodies:
        body.gravcomp = 1.0
    # MuJoCo lets a body and its parent pass through each other, but not where the parent is fixed to the world.
    standing = [body for body in range(1, model.nbody) if model.body_weldid[body] == 0]
    for body in standing:
        names = {model.body(body).name, model.body(model.jnt_bodyid[first_joint]).name}
        if not any({exclude.bodyname1, exclude.bodyname2} == names for exclude in spec.excludes):
            spec.add_exclude(bodyname1=min(names), bodyname2=max(names))
    alone = spec.compile()
    data = make_quiet_data(alone)
    data.qpos[:] = home
    mujoco.mj_fwdPosition(alone, data)
    if data.ncon:
        a, b = (alone.body(int(body)).name for body in alone.geom_bodyid[data.contact.geom[0]])
        raise robot_error(f"at home {a!r} touches {b!r}: exclude the pair, or choose another {HOME_KEY!r}")


def _check_chain(model: mujoco.MjModel, base: int, joints: list[int]) -> None:
    if model.body_jntnum[base]:
        raise robot_error(f"the base {model.body(base).name!r} has a joint: an arm stands still on its base")
    if (model.jnt_type == _FREE).any() or len(np.flatnonzero(model.body_parentid[1:] == 0)) != 1:
        raise robot_error("there is more than one body in the world, or one that is free: give the arm alone")
    if not joints:
        raise robot_error(f"no joint lies between the base and the site {TCP_SITE!r}")
    for joint in joints:
        if model.jnt_type[joint] != _HINGE or not model.jnt_limited[joint]:
            raise robot_error(f"the joint {model.joint(joint).name!r} must be a hinge with a range")


def _find_servo(model: mujoco.MjModel, joint: int) -> int:
    """Find the position actuator of a joint."""
    of_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
    found = np.flatnonzero(of_joint)
    called = model.joint(joint).name
    if len(found) != 1:
        raise robot_error(f"the joint {called!r} has {len(found)} actuators: give it one, of the kind position")
    servo = int(found[0])
    stiffness, back = float(model.actuator_gainprm[servo, 0]), float(model.actuator_biasprm[servo, 1])
    affine = model.actuator_biastype[servo] == mujoco.mjtBias.mjBIAS_AFFINE
    direct = model.actuator_dyntype[servo] == mujoco.mjtDyn.mjDYN_NONE and model.actuator_gear[servo, 0] == 1.0
    if not (affine and direct and stiffness > 0.0 and np.isclose(stiffness, -back)):
        raise robot_error(
            f"the actuator of the joint {called!r} does not control its position: use the kind position, with gear 1"
        )
    return servo


def _find_gripper_actuator(model: mujoco.MjModel, servos: list[int]) -> int:
    others = [actuator for actuator in range(model.nu) if actuator not in servos]
    if len(others) != 1:
        raise robot_error(f"there are {len(others)} actuators besides the joints': give one, which opens the gripper")
    if not model.actuator_ctrllimited[others[0]]:
        raise robot_error(f"the gripper's actuator {model.actuator(others[0]).name!r} needs a ctrlrange")
    return others[0]


def _read_home(model: mujoco.MjModel) -> JointVector:
    """Read all positions of the home keyframe."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, HOME_KEY)
    if key < 0:
        raise robot_error(f"there is no keyframe {HOME_KEY!r}: add one with the arm where it waits")
    return np.array(model.key_qpos[key])


def _compute_limits(model: mujoco.MjModel, joints: list[int], servos: list[int]) -> tuple[JointVector, JointVector]:
    """Intersect joint ranges with actuator control ranges [rad]."""
    lower, upper = np.array(model.jnt_range[joints]).T
    limited = model.actuator_ctrllimited[servos] != 0
    told = np.array(model.actuator_ctrlrange[servos]).T
    return np.where(limited, np.maximum(lower, told[0]), lower), np.where(limited, np.minimum(upper, told[1]), upper)


def _read_max_torque(model: mujoco.MjModel, joint: int, servo: int) -> float:
    if model.actuator_forcelimited[servo]:
        return float(np.abs(model.actuator_forcerange[servo]).min())
    if model.jnt_actfrclimited[joint]:
        return float(np.abs(model.jnt_actfrcrange[joint]).min())
    raise robot_error(f"the actuator of the joint {model.joint(joint).name!r} needs a forcerange [N m]")


def _read_numeric(model: mujoco.MjModel, name: str, count: int, default: float) -> JointVector:
    """Read a `numeric`: one positive number per joint, or one for all."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if index < 0:
        return np.full(count, default)
    first, size = int(model.numeric_adr[index]), int(model.numeric_size[index])
    values = np.array(model.numeric_data[first : first + size])
    if size not in (1, count) or not (values > 0.0).all():
        raise robot_error(f"the numeric {name!r} has {values.tolist()}: give {count} positive numbers, or one")
    return np.broadcast_to(values, (count,)).copy()


def _measure_base_radius(model: mujoco.MjModel, base: int) -> float:
    """Measure the circle around z that contains the colliding geoms near the foot [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    radius = _MIN_BASE_RADIUS_M
    for geom in np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0):
        shape = make_geom_mesh(model, int(geom))
        if shape is not None and model.geom_contype[geom] and model.body_rootid[model.geom_bodyid[geom]] == base:
            points = shape.vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            low = points[points[:, 2] < _FOOT_HEIGHT_M]
            radius = max(radius, float(np.hypot(low[:, 0], low[:, 1]).max(initial=0.0)))
    return radius


def _require_name(item: mujoco.MjModel, what: str) -> str:
    name: str = item.name
    if not name:
        raise robot_error(f"a {what} has no name: give it one")
    return name
