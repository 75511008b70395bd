"""Robot and scene as one collision world: which configurations touch what, in each phase of a motion.

The world is the station's own compiled model, copied: planner and simulator see the same shapes, the scene as its
convex pieces. MuJoCo's broad and narrow phase do the work; masks see to it that only pairs with something that moves
are looked at, so a check costs some ten microseconds. All stands in the table frame: the obstacles are where the
simulator has them, and it is the goals of the inverse kinematics that are mapped into the robot's base frame
(`World.in_base`); a planner that wants the obstacles there maps them itself (`motion.curobo`).
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import JointPath, JointVector
from tableverse_factory.geometry.math.transforms import (
    compose,
    inverse,
    pose_from_matrix,
)
from tableverse_factory.physics.mjcf.spec import TABLE
from tableverse_factory.robotics.motion.carried_object import Carried
from tableverse_factory.robotics.motion.dynamics import Dynamics
from tableverse_factory.robotics.motion.kinematics import chain_of
from tableverse_factory.robotics.robots.station import Station

Pair = tuple[int, int]
"""Two geoms by their ids, ascending."""

EXACT_M = 1e-5
"""Below this depth a touch is the collision routine's own error [m]."""

_MOVING, _SELF, _HELD, _HELD_ROBOT = 1, 2, 4, 8


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """What counts as free in one phase of a motion. Made by `World.space`; the allowances are written there.

    Attributes:
        world: Which it is a view of.
        opening_m: Distance between the fingers [m].
        margin_m: Least distance from the arm, and from what it carries, to the scene [m].
        carried: What is between the fingers; its pairs with the gripper are not looked at.
        standing: Objects that stand elsewhere than in the exported scene, by id.
        resting: Pairs of the carried object that may touch, and how deep at most: as where it was taken or is let go.
    """

    world: "World"
    opening_m: float
    margin_m: float = 0.0
    carried: Carried | None = None
    standing: Mapping[str, Pose] = field(default_factory=dict)
    resting: Mapping[Pair, float] = field(default_factory=dict)

    def free(self, q: JointVector) -> bool:
        """Whether nothing is nearer than it may be at a configuration. Shape of `q`: (j,) [rad]."""
        return self.world.is_free(self, q)

    def free_edge(self, start: JointVector, goal: JointVector, step_rad: float) -> bool:
        """Whether a straight line in joint space is free, its ends taken to be; looked at from coarse to fine.

        Args:
            start: Shape (j,) [rad].
            goal: Shape (j,) [rad].
            step_rad: Largest motion of any joint between two checks [rad].
        """
        count = int(np.ceil(float(np.abs(goal - start).max()) / step_rad))
        return all(self.free(start + (goal - start) * (k / count)) for k in _coarse_to_fine(count))

    def first_hit(self, path: JointPath) -> int | None:
        """Index of the first configuration of a row that is not free."""
        return next((index for index, q in enumerate(path) if not self.free(q)), None)


class World:
    """A station at one base, to be asked for collisions.

    Attributes:
        station: The scene and the arm.
        chain: The arm, from its base to the TCP.
        base: The arm's base in the table frame.
        dynamics: Of the arm alone.
        table_geom: Id of the slab, if there is one of that name.
        unseen: Objects without any convex piece: no plan can avoid them, none is made.
    """

    def __init__(self, station: Station, base: Pose | None = None) -> None:
        """Copies the station's model, with its base at `base`; by default where the station has it now."""
        self.station = station
        self.base = station.base if base is None else base
        self._model: mujoco.MjModel = copy.copy(station.model)
        self._model.body_pos[station.base_body] = self.base.position
        self._model.body_quat[station.base_body] = self.base.quaternion_wxyz
        self._data = mujoco.MjData(self._model)
        self._exported = np.array(station.model.qpos0)
        limits = (station.arm.lower, station.arm.upper)
        self.chain = chain_of(self._model, _joint_names(station), station.base_body, station.tcp_site, limits)
        self._joints = _as_slice(station.joint_qpos)
        self._masks = _Masks.of(station)
        solid = set(self._model.geom_bodyid[self._masks.solid].tolist())
        self.unseen = tuple(name for name, body in station.object_bodies.items() if body not in solid)
        self.dynamics = Dynamics(station.arm)
        table = mujoco.mj_name2id(station.model, mujoco.mjtObj.mjOBJ_GEOM, TABLE)
        self.table_geom: int | None = table if table >= 0 else None
        self._current: Space | None = None
        self._turn = np.empty((3, 4))

    def in_base(self, tcp: Pose) -> Pose:
        """A pose of the table frame in the robot's base frame: T_base⁻¹ · T (paper, appendix D)."""
        return compose(inverse(self.base), tcp)

    def tcp(self, q: JointVector) -> Pose:
        """The TCP in the table frame."""
        return compose(self.base, pose_from_matrix(self.chain.pose_matrix(q)))

    def object_pose(self, object_id: str) -> Pose:
        """Where an object stands in the exported scene."""
        at = self.station.object_qpos[object_id]
        return Pose(self._exported[at : at + 3].copy(), self._exported[at + 3 : at + 7].copy())

    def space(
        self,
        opening_m: float,
        *,
        margin_m: float = 0.0,
        carried: Carried | None = None,
        standing: Mapping[str, Pose] | None = None,
        resting: Mapping[Pair, float] | None = None,
    ) -> Space:
        """What is free with the fingers at this opening; the rest as `Space` says.

        Always looked at: the arm with itself (at no margin), the arm with the scene, the carried object with the scene
        and with the arm but for the gripper that holds it. An object that is not carried is an obstacle for all of the
        arm, also the one to be grasped: open fingers that touch it would push it.
        """
        return Space(self, opening_m, margin_m, carried, standing or {}, resting or {})

    def is_free(self, space: Space, q: JointVector) -> bool:
        """Whether nothing is nearer than the space allows at a configuration."""
        self._touch(space, q)
        data = self._data
        if data.ncon == 0:
            return True
        distances = data.contact.dist
        if space.margin_m == 0.0 and not space.resting:
            return float(distances.min()) >= -EXACT_M
        return all(
            distance >= self._least(space, first, second)
            for (first, second), distance in zip(data.contact.geom.tolist(), distances.tolist(), strict=True)
        )

    def touching(self, space: Space, q: JointVector) -> dict[Pair, float]:
        """Signed distance [m] of each pair within the margin at a configuration, the deepest of its contacts."""
        self._touch(space, q)
        found: dict[Pair, float] = {}
        for (first, second), distance in zip(
            self._data.contact.geom.tolist(), self._data.contact.dist.tolist(), strict=True
        ):
            pair = (min(first, second), max(first, second))
            found[pair] = min(distance, found.get(pair, np.inf))
        return found

    def depth(self, space: Space, q: JointVector) -> float:
        """How deep the deepest pair is at a configuration; 0 where nothing touches [m]."""
        return max(0.0, -min(self.touching(space, q).values(), default=0.0))

    def pairs_of(self, object_id: str, pairs: Mapping[Pair, float]) -> dict[Pair, float]:
        """Those of an object with the scene, not with the arm."""
        body, owner, robot = self.station.object_bodies[object_id], self._model.geom_bodyid, self._masks.robot
        return {
            pair: distance
            for pair, distance in pairs.items()
            if body in owner[list(pair)] and not robot[list(pair)].any()
        }

    def blocked_by(self, space: Space, q: JointVector) -> str:
        """What is too near, for people: the two bodies and their distance; empty where all is free."""
        for (first, second), distance in sorted(self.touching(space, q).items(), key=lambda item: item[1]):
            if distance < self._least(space, first, second):
                names = [self._model.body(self._model.geom_bodyid[geom]).name or "world" for geom in (first, second)]
                return f"{names[0]} and {names[1]}: {1000 * distance:.1f} mm"
        return ""

    def _least(self, space: Space, first: int, second: int) -> float:
        """Smallest signed distance that a pair may have [m]."""
        robot = self._masks.robot
        if robot[first] and robot[second]:
            return -EXACT_M
        depth = space.resting.get((min(first, second), max(first, second)))
        if depth is not None:
            return min(depth, 0.0) - EXACT_M
        return space.margin_m if space.margin_m > 0.0 else -EXACT_M

    def _touch(self, space: Space, q: JointVector) -> None:
        """Contacts of everything that the space looks at."""
        if space is not self._current:
            self._enter(space)
        model, data = self._model, self._data
        data.qpos[self._joints] = q
        mujoco.mj_kinematics(model, data)
        if space.carried is not None:
            self._carry(space.carried)
            mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)

    def _carry(self, carried: Carried) -> None:
        data, site, turn = self._data, self.station.tcp_site, self._turn
        at, hang = self.station.object_qpos[carried.object_id], carried.object_to_tcp
        mujoco.mju_mat2Quat(turn[0], data.site_xmat[site])
        mujoco.mju_mulQuat(turn[1], turn[0], hang.quaternion_wxyz)
        mujoco.mju_rotVecQuat(turn[2, :3], hang.position, turn[0])
        data.qpos[at : at + 3] = data.site_xpos[site] + turn[2, :3]
        data.qpos[at + 3 : at + 7] = turn[1]

    def _enter(self, space: Space) -> None:
        """Sets fingers, objects, masks and margins."""
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
class _Masks(Frozen):
    """Which geoms belong to what. Each of shape (ngeom,)."""

    solid: np.ndarray
    robot: np.ndarray
    moving: np.ndarray
    gripper: np.ndarray

    @classmethod
    def of(cls, station: Station) -> "_Masks":
        model = station.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        body = model.geom_bodyid
        robot = np.isin(body, station.arm_bodies)
        moving = robot & (model.body_weldid[body] != model.body_weldid[station.base_body])
        hand = int(model.site_bodyid[station.tcp_site])
        return cls(solid, robot & solid, moving & solid, np.isin(body, _below(model, hand)) & solid)

    def apply(self, model: mujoco.MjModel, held: int | None, margin_m: float) -> None:
        """Writes the masks and margins into a model; geoms that touch nothing in the simulation touch nothing here."""
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


def _coarse_to_fine(count: int) -> list[int]:
    """1 to count - 1: the middle first, then the quarters, and so on; a wall is found with few checks."""
    order: list[int] = []
    seen = {0, count}
    stride = count
    while stride > 1:
        stride = (stride + 1) // 2
        order += [k for k in range(stride, count, stride) if k not in seen]
        seen.update(order)
    return order


def _joint_names(station: Station) -> tuple[str, ...]:
    model = station.model
    by_address = {int(address): model.joint(joint).name for joint, address in enumerate(model.jnt_qposadr)}
    return tuple(by_address[int(address)] for address in station.joint_qpos)


def _as_slice(indices: np.ndarray) -> slice | np.ndarray:
    """The same addresses as a slice where they are in a row: half the time of writing there."""
    first = int(indices[0])
    return slice(first, first + len(indices)) if (np.diff(indices) == 1).all() else indices


def _below(model: mujoco.MjModel, top: int) -> list[int]:
    found = {top}
    for body in range(top + 1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return sorted(found)
