"""Panda-like seven-joint arm with a parallel gripper, built from published figures and primitive shapes.

Kinematics and limits follow the manufacturer: modified Denavit-Hartenberg table, ranges, speeds, accelerations and
torques of its control interface. Masses, centers and inertias of the links are those identified by Gaz et al., "Dynamic
identification of the Franka Emika Panda robot with retrieval of feasible parameters" (RA-L 2019); reflected inertias of
the drives those published for the sister model FR3. The capsules, cylinders and boxes are original.
"""

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from tableverse_factory.robotics.robots.arm import Arm, GripperShape
from tableverse_factory.robotics.robots.panda_shapes import (
    COLLISION_SHAPES,
    FINGER_ROOT_M,
    FINGER_VISUAL,
    HAND,
    HAND_VISUAL,
    PAD,
    SHANK,
    VISUAL_SHAPES,
    LinkShape,
)

COLLISION_GROUP, VISUAL_GROUP = 3, 2
MAX_OPENING_M = 0.08
GRIP_FORCE_N = 60.0
# Sliding, torsional [m], rolling [m]; the pads have contact priority, so it applies whatever they touch
PAD_FRICTION = (0.5, 0.01, 0.0001)
TCP_BEYOND_FLANGE_M = 0.1034
# Damping over stiffness of every servo [s]: all joints follow their command equally late, so the path is kept
LAG_S = 0.03


@dataclass(frozen=True, slots=True)
class _Joint:
    """Row of the DH table: `a` [m] and `alpha` [rad] of the previous link, `d` [m], and the drive's limits."""

    a: float
    alpha: float
    d: float
    range: tuple[float, float]
    velocity: float
    acceleration: float
    torque: float
    stiffness: float
    reflected_inertia: float


@dataclass(frozen=True, slots=True)
class _Link:
    """Mass [kg], center of mass [m], inertia about it (xx, yy, zz, xy, xz, yz) [kg m²], in the link's frame."""

    mass: float
    center: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]


_QUARTER = np.pi / 2
JOINTS = (
    _Joint(0.0, 0.0, 0.333, (-2.8973, 2.8973), 2.175, 15.0, 87.0, 6000.0, 0.6057),
    _Joint(0.0, -_QUARTER, 0.0, (-1.7628, 1.7628), 2.175, 7.5, 87.0, 6000.0, 0.6057),
    _Joint(0.0, _QUARTER, 0.316, (-2.8973, 2.8973), 2.175, 10.0, 87.0, 4500.0, 0.4625),
    _Joint(0.0825, _QUARTER, 0.0, (-3.0718, -0.0698), 2.175, 12.5, 87.0, 4500.0, 0.4625),
    _Joint(-0.0825, -_QUARTER, 0.384, (-2.8973, 2.8973), 2.61, 15.0, 12.0, 1500.0, 0.2055),
    _Joint(0.0, _QUARTER, 0.0, (-0.0175, 3.7525), 2.61, 20.0, 12.0, 1500.0, 0.2055),
    _Joint(0.088, _QUARTER, 0.0, (-2.8973, 2.8973), 2.61, 20.0, 12.0, 1500.0, 0.2055),
)
FLANGE_M = 0.107
HOME = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4)

_LINKS = (
    _Link(0.629769, (-0.041018, -0.00014, 0.049974), (0.00315, 0.00388, 0.004285, 8.2904e-7, 0.00015, 8.2299e-6)),
    _Link(4.970684, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    _Link(0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    _Link(3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    _Link(3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    _Link(1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    _Link(1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    _Link(0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
)
_HAND = _Link(0.73, (-0.01, 0.0, 0.03), (0.001, 0.0025, 0.0017, 0.0, 0.0, 0.0))
_FINGER = _Link(0.015, (0.0, 0.012, 0.024), (2.4e-6, 2.4e-6, 7.5e-7, 0.0, 0.0, 0.0))


@lru_cache(maxsize=1)
def build_panda() -> Arm:
    """Build the arm; at home its TCP is at (0.307, 0, 0.487) m with the gripper pointing down."""
    names = tuple(f"joint{index}" for index in range(1, len(JOINTS) + 1))
    tcp = np.array([0.0, 0.0, TCP_BEYOND_FLANGE_M])
    root = np.array([0.0, 0.0, FINGER_ROOT_M])
    return Arm(
        name="panda",
        template=_build_spec(),
        base_body="link0",
        joint_names=names,
        actuator_names=names,
        gripper_actuator="gripper",
        gripper_control=(0.0, MAX_OPENING_M),
        tcp_site="tcp",
        finger_joints=("finger_left", "finger_right"),
        finger_open=np.full(2, MAX_OPENING_M / 2),
        finger_closed=np.zeros(2),
        finger_geoms=("pad_left", "pad_right"),
        home=np.array(HOME),
        lower=np.array([joint.range[0] for joint in JOINTS]),
        upper=np.array([joint.range[1] for joint in JOINTS]),
        max_velocity=np.array([joint.velocity for joint in JOINTS]),
        max_acceleration=np.array([joint.acceleration for joint in JOINTS]),
        max_torque=np.array([joint.torque for joint in JOINTS]),
        max_opening_m=MAX_OPENING_M,
        max_opening_speed=0.1,
        base_radius_m=0.16,
        shape=GripperShape(
            hand_centers=np.array([HAND.a]) - tcp,
            hand_half_sizes=np.array([HAND.b]),
            finger_centers=np.array([SHANK.a, PAD.a]) + root - tcp,
            finger_half_sizes=np.array([SHANK.b, PAD.b]),
            pad_half_size_xz=np.array([PAD.b[0], PAD.b[2]]),
        ),
    )


def _build_spec() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.modelname = "panda"
    spec.compiler.degree = False
    body = _add_body(spec.worldbody, "link0", _LINKS[0])
    _add_shapes(body, COLLISION_SHAPES[0], VISUAL_SHAPES[0])
    for index, (joint, link) in enumerate(zip(JOINTS, _LINKS[1:], strict=True), start=1):
        body = _add_body(body, f"link{index}", link)
        cos, sin = np.cos(joint.alpha), np.sin(joint.alpha)
        body.pos = [joint.a, -sin * joint.d, cos * joint.d]
        body.quat = [np.cos(joint.alpha / 2), np.sin(joint.alpha / 2), 0.0, 0.0]
        hinge = body.add_joint(name=f"joint{index}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
        hinge.range, hinge.armature = joint.range, joint.reflected_inertia
        _add_shapes(body, COLLISION_SHAPES[index], VISUAL_SHAPES[index])
        _add_servo(spec, f"joint{index}", joint)
        spec.add_exclude(bodyname1=f"link{index - 1}", bodyname2=f"link{index}")
    _add_gripper(spec, body)
    return spec


def _add_body(parent: mujoco.MjsBody, name: str, link: _Link) -> mujoco.MjsBody:
    body = parent.add_body(name=name, gravcomp=1.0)
    body.mass, body.ipos, body.fullinertia = link.mass, link.center, link.inertia
    body.explicitinertial = True
    return body


def _add_shapes(body: mujoco.MjsBody, touch: tuple[LinkShape, ...], look: tuple[LinkShape, ...]) -> None:
    for index, shape in enumerate(touch):
        _add_geom(body, f"{body.name}_{index}", shape).group = COLLISION_GROUP
    for index, shape in enumerate(look):
        geom = _add_geom(body, f"{body.name}_look_{index}", shape)
        geom.group, geom.contype, geom.conaffinity = VISUAL_GROUP, 0, 0


def _add_geom(body: mujoco.MjsBody, name: str, shape: LinkShape) -> mujoco.MjsGeom:
    geom = body.add_geom(name=name, type=shape.kind, rgba=shape.rgba)
    if shape.kind == mujoco.mjtGeom.mjGEOM_BOX:
        geom.pos, geom.size = shape.a, shape.b
    else:
        geom.fromto, geom.size = [*shape.a, *shape.b], [shape.radius, 0.0, 0.0]
    return geom


def _add_servo(spec: mujoco.MjSpec, name: str, joint: _Joint) -> None:
    servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    _make_position(servo, joint.stiffness, LAG_S * joint.stiffness)
    servo.ctrllimited, servo.ctrlrange = True, joint.range
    servo.forcelimited, servo.forcerange = True, [-joint.torque, joint.torque]


def _make_position(servo: mujoco.MjsActuator, stiffness: float, damping: float) -> None:
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    servo.gainprm[0] = stiffness
    servo.biasprm[:3] = [0.0, -stiffness, -damping]


def _add_gripper(spec: mujoco.MjSpec, wrist: mujoco.MjsBody) -> None:
    hand = _add_body(wrist, "hand", _HAND)
    hand.pos = [0.0, 0.0, FLANGE_M]
    hand.quat = [np.cos(np.pi / 8), 0.0, 0.0, -np.sin(np.pi / 8)]
    _add_shapes(hand, (HAND,), HAND_VISUAL)
    hand.add_site(name="tcp", pos=[0.0, 0.0, TCP_BEYOND_FLANGE_M], size=[0.002, 0.002, 0.002])
    for name, turn in (("left", (1.0, 0.0, 0.0, 0.0)), ("right", (0.0, 0.0, 0.0, 1.0))):
        _add_finger(hand, name, turn)
        spec.add_exclude(bodyname1="hand", bodyname2=f"finger_{name}")
        spec.add_exclude(bodyname1="link7", bodyname2=f"finger_{name}")
    spec.add_exclude(bodyname1="link7", bodyname2="hand")
    spec.add_exclude(bodyname1="link6", bodyname2="hand")
    spec.add_exclude(bodyname1="finger_left", bodyname2="finger_right")
    _couple_fingers(spec)


def _add_finger(hand: mujoco.MjsBody, name: str, turn: tuple[float, float, float, float]) -> None:
    finger = _add_body(hand, f"finger_{name}", _FINGER)
    finger.pos, finger.quat = [0.0, 0.0, FINGER_ROOT_M], turn
    slide = finger.add_joint(name=f"finger_{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
    slide.range, slide.armature = [0.0, MAX_OPENING_M / 2], 0.1
    _add_shapes(finger, (SHANK,), FINGER_VISUAL)
    pad = _add_geom(finger, f"pad_{name}", PAD)
    pad.group = COLLISION_GROUP
    pad.condim, pad.friction, pad.priority = 4, PAD_FRICTION, 1
    pad.solref, pad.solimp[:3] = [0.005, 1.0], [0.95, 0.99, 0.001]


def _couple_fingers(spec: mujoco.MjSpec) -> None:
    """Make both fingers move alike; one servo acts on their sum, the opening."""
    equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="finger_right", name2="finger_left")
    equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
    equality.data[:5] = [0.0, 1.0, 0.0, 0.0, 0.0]
    equality.solref, equality.solimp[:3] = [0.005, 1.0], [0.95, 0.99, 0.001]
    tendon = spec.add_tendon(name="opening")
    tendon.wrap_joint("finger_left", 1.0)
    tendon.wrap_joint("finger_right", 1.0)
    servo = spec.add_actuator(name="gripper", target="opening", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    _make_position(servo, 5000.0, 100.0)
    servo.ctrllimited, servo.ctrlrange = True, [0.0, MAX_OPENING_M]
    servo.forcelimited, servo.forcerange = True, [-GRIP_FORCE_N, GRIP_FORCE_N]
