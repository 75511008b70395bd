"""Collision world of robot and scene: which configurations touch what, in each phase of a motion.

The world is a copy of the station's compiled model, so planner and simulator share shapes, the scene as its convex
pieces. MuJoCo's broad and narrow phase do the work; masks restrict it to pairs with a moving geom, so a check takes
some ten microseconds. All poses are in the table frame; only goals of the inverse kinematics are mapped into the
robot's base frame (`CollisionWorld.in_base`). Planners that need obstacles there map them themselves (`motion.curobo`).
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import JointPath, JointVector
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, pose_from_matrix
from tableverse_factory.physics.mjcf.spec import TABLE
from tableverse_factory.robotics.motion.dynamics import ArmDynamics, CarriedObject
from tableverse_factory.robotics.motion.kinematics import build_chain
from tableverse_factory.robotics.robots.station import PREFIX, Station, find_subtree

Pair = tuple[int, int]  # two geom ids, ascending
CONTACT_TOLERANCE_M = 1e-5  # penetration below this is the collision routine's own error [m]
_MOVING, _SELF, _HELD, _HELD_ROBOT = 1, 2, 4, 8


@dataclass(frozen=True, slots=True, eq=False)
class CollisionSpace:
    """Free space in one phase of a motion.

    Always checked: the arm with itself (without margin), the arm with the scene, and the carried object with the scene
    and with the arm except its gripper. An object that is not carried, also the one to be grasped, is an obstacle for
    the whole arm: open fingers that touch it would push it. `standing` gives poses of objects that are not where they
    were exported, `resting` pairs of the carried object that may touch, with their maximum depth [m].
    """

    world: "CollisionWorld"
    opening_m: float  # distance between the fingers
    margin_m: float = 0.0  # minimum distance of the arm and its payload from the scene
    carried: CarriedObject | None = None  # between the fingers; its pairs with the gripper are ignored
    standing: Mapping[str, Pose] = field(default_factory=dict)
    resting: Mapping[Pair, float] = field(default_factory=dict)

    def is_free(self, q: JointVector) -> bool:
        """Test whether all distances are respected at a configuration."""
        return self.world.is_free(self, q)

    def is_edge_free(self, start: JointVector, goal: JointVector, step_rad: float) -> bool:
        """Test a line in joint space between free ends, coarse to fine, in joint steps of at most `step_rad`."""
        count = int(np.ceil(float(np.abs(goal - start).max()) / step_rad))
        return all(self.is_free(start + (goal - start) * (k / count)) for k in _order_coarse_to_fine(count))

    def find_first_collision(self, path: JointPath) -> int | None:
        """Return the index of the first configuration that is not free."""
        return next((index for index, q in enumerate(path) if not self.is_free(q)), None)


class CollisionWorld:
    """Station at one base, for collision queries."""

    def __init__(self, station: Station, base: Pose | None = None) -> None:
        """Copy the station's model, with its base at `base`, by default its present one."""
        self.station = station
        self.base = station.base if base is None else base
        self._model: mujoco.MjModel = copy.copy(station.model)
        self._model.body_pos[station.base_body] = self.base.position
        self._model.body_quat[station.base_body] = self.base.quaternion_wxyz
        self._data = mujoco.MjData(self._model)
        self._exported = np.array(station.model.qpos0)
        limits = (station.arm.lower, station.arm.upper)
        joints = tuple(PREFIX + name for name in station.arm.joint_names)
        self.chain = build_chain(self._model, joints, station.base_body, station.tcp_site, limits)
        self._joints = _as_slice(station.joint_qpos)
        self._masks = _CollisionMasks.of(station)
        solid = set(self._model.geom_bodyid[self._masks.solid].tolist())
        # Objects without any convex piece, which cannot be avoided: no motion is planned beside them
        self.unseen = tuple(name for name, body in station.object_bodies.items() if body not in solid)
        self.dynamics = ArmDynamics(station.arm)
        table = mujoco.mj_name2id(station.model, mujoco.mjtObj.mjOBJ_GEOM, TABLE)
        self.table_geom: int | None = table if table >= 0 else None
        self._current: CollisionSpace | None = None
        self._turn = np.empty((3, 4))

    def in_base(self, tcp: Pose) -> Pose:
        """Map a pose of the table frame into the robot's base frame: T_base⁻¹ · T (paper, appendix D)."""
        return compose_poses(invert_pose(self.base), tcp)

    def tcp(self, q: JointVector) -> Pose:
        """Compute the TCP in the table frame."""
        return compose_poses(self.base, pose_from_matrix(self.chain.pose_matrix(q)))

    def object_pose(self, object_id: str) -> Pose:
        """Return an object's exported pose."""
        at = self.station.object_qpos[object_id]
        return Pose(self._exported[at : at + 3].copy(), self._exported[at + 3 : at + 7].copy())

    def is_free(self, space: CollisionSpace, q: JointVector) -> bool:
        """Test whether all distances of a space are respected at a configuration."""
        self._compute_contacts(space, q)
        data = self._data
        if data.ncon == 0:
            return True
        distances = data.contact.dist
        if space.margin_m == 0.0 and not space.resting:
            return float(distances.min()) >= -CONTACT_TOLERANCE_M
        return all(
            distance >= self._allowed_distance(space, first, second)
            for (first, second), distance in zip(data.contact.geom.tolist(), distances.tolist(), strict=True)
        )

    def find_contacts(self, space: CollisionSpace, q: JointVector) -> dict[Pair, float]:
        """Return the least signed distance [m] of each pair within the margin at a configuration."""
        self._compute_contacts(space, q)
        found: dict[Pair, float] = {}
        contact = self._data.contact
        for (first, second), distance in zip(contact.geom.tolist(), contact.dist.tolist(), strict=True):
            pair = (min(first, second), max(first, second))
            found[pair] = min(distance, found.get(pair, np.inf))
        return found

    def compute_depth(self, space: CollisionSpace, q: JointVector) -> float:
        """Compute the deepest penetration at a configuration; 0 without contact [m]."""
        return max(0.0, -min(self.find_contacts(space, q).values(), default=0.0))

    def select_object_pairs(self, object_id: str, pairs: Mapping[Pair, float]) -> dict[Pair, float]:
        """Select pairs of an object with the scene, not with the arm."""
        body, owner, robot = self.station.object_bodies[object_id], self._model.geom_bodyid, self._masks.robot
        return {
            pair: distance
            for pair, distance in pairs.items()
            if body in owner[list(pair)] and not robot[list(pair)].any()
        }

    def describe_collision(self, space: CollisionSpace, q: JointVector) -> str:
        """Describe the worst violation by its two bodies and their distance; empty where all is free."""
        for (first, second), distance in sorted(self.find_contacts(space, q).items(), key=lambda item: item[1]):
            if distance < self._allowed_distance(space, first, second):
                names = [self._model.body(self._model.geom_bodyid[geom]).name or "world" for geom in (first, second)]
                return f"{names[0]} and {names[1]}: {1000 * distance:.1f} mm"
        return ""

    def _allowed_distance(self, space: CollisionSpace, first: int, second: int) -> float:
        """Return the smallest signed distance that a pair may have [m]."""
        robot = self._masks.robot
        if robot[first] and robot[second]:
            return -CONTACT_TOLERANCE_M
        depth = space.resting.get((min(first, second), max(first, second)))
        if depth is not None:
            return min(depth, 0.0) - CONTACT_TOLERANCE_M
        return space.margin_m if space.margin_m > 0.0 else -CONTACT_TOLERANCE_M

    def _compute_contacts(self, space: CollisionSpace, q: JointVector) -> None:
        if space is not self._current:
            self._switch_space(space)
        model, data = self._model, self._data
        data.qpos[self._joints] = q
        mujoco.mj_kinematics(model, data)
        if space.carried is not None:
            self._place_carried(space.carried)
            mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)

    def _place_carried(self, carried: CarriedObject) -> None:
        data, site, turn = self._data, self.station.tcp_site, self._turn
        at, hang = self.station.object_qpos[carried.object_id], carried.object_to_tcp
        mujoco.mju_mat2Quat(turn[0], data.site_xmat[site])
        mujoco.mju_mulQuat(turn[1], turn[0], hang.quaternion_wxyz)
        mujoco.mju_rotVecQuat(turn[2, :3], hang.position, turn[0])
        data.qpos[at : at + 3] = data.site_xpos[site] + turn[2, :3]
        data.qpos[at + 3 : at + 7] = turn[1]

    def _switch_space(self, space: CollisionSpace) -> None:
        """Set fingers, objects, masks and margins."""
        model, data, station = self._model, self._data, self.station
        data.qpos[:] = self._exported
        data.qpos[station.finger_qpos] = station.arm.finger_positions(space.opening_m)
        for object_id, pose in space.standing.items():
            at = station.object_qpos[object_id]
            data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = pose.position, pose.quaternion_wxyz
        held = None if space.carried is None else station.object_bodies[space.carried.object_id]
        self._masks.apply(model, held, space.margin_m)
        self._current = space


@dataclass(frozen=True, slots=True, eq=False)
class _CollisionMasks(Frozen):
    """Geom masks by role. Each of shape (ngeom,)."""

    solid: np.ndarray
    robot: np.ndarray
    moving: np.ndarray
    gripper: np.ndarray

    @classmethod
    def of(cls, station: Station) -> "_CollisionMasks":
        model = station.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        body = model.geom_bodyid
        robot = np.isin(body, station.arm_bodies)
        moving = robot & (model.body_weldid[body] != model.body_weldid[station.base_body])
        hand = int(model.site_bodyid[station.tcp_site])
        return cls(solid, robot & solid, moving & solid, np.isin(body, find_subtree(model, hand)) & solid)

    def apply(self, model: mujoco.MjModel, held: int | None, margin_m: float) -> None:
        """Write masks and margins into a model; geoms without contacts in the simulation stay without here."""
        own = np.zeros(model.ngeom, dtype=bool) if held is None else self.solid & (model.geom_bodyid == held)
        scene = self.solid & ~self.robot & ~own
        contype = _MOVING * self.moving + _SELF * self.robot + (_HELD | _HELD_ROBOT) * own
        conaffinity = (_MOVING | _HELD) * scene + _SELF * self.robot + _HELD_ROBOT * (self.robot & ~self.gripper)
        model.geom_contype[:], model.geom_conaffinity[:] = contype, conaffinity
        model.geom_margin[:] = np.where(self.robot | own, margin_m, 0.0)
        for body in range(model.nbody):
            geoms = slice(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
            model.body_contype[body] = np.bitwise_or.reduce(model.geom_contype[geoms])
            model.body_conaffinity[body] = np.bitwise_or.reduce(model.geom_conaffinity[geoms])
            model.body_margin[body] = max(model.geom_margin[geoms], default=0.0)


def _order_coarse_to_fine(count: int) -> list[int]:
    """Order 1 to count - 1 as middle, quarters, and so on, so that walls are found with few checks."""
    order: list[int] = []
    seen = {0, count}
    stride = count
    while stride > 1:
        stride = (stride + 1) // 2
        order += [k for k in range(stride, count, stride) if k not in seen]
        seen.update(order)
    return order


def _as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """Convert consecutive addresses to a slice, which halves the time of writing there."""
    first = int(indices[0])
    return slice(first, first + len(indices)) if (np.diff(indices) == 1).all() else indices
