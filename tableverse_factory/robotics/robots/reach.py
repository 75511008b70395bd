"""Where an arm's gripper can point straight down: a map over distance from the base's axis and height above its foot.

Computed once per arm by inverse kinematics that spreads from cell to cell, each starting from its neighbour's joints;
good for choosing a base, no promise that a grasp of another direction is reached.
"""

from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from schemas.geometry import Frozen, Vector3
from schemas.trajectories import JointVector, Numbers
from tableverse_factory.physics.simulate.at_rest import quiet_data
from tableverse_factory.robotics.robots.arm import Arm

CELL_M = 0.05
FARTHEST_M = 1.5
HIGHEST_M = 0.8
LIMIT_MARGIN_RAD = 0.1
"""Joints keep this far from their stops: what is only just reached leaves no way to go on."""

_DOWNWARD = np.diag([1.0, -1.0, -1.0])
_ITERATIONS = 30
_RESTARTS = 16
_TOLERANCE = 1e-3
_DAMPING = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Reach(Frozen):
    """A map of cells of `CELL_M`, the first around distance 0 and height 0.

    Attributes:
        cells: Which are reached; rows are distances, columns heights. Shape (r, z).
        margins: Of each reached cell the distance to the nearest that is not [m], 0 where it is not reached itself.
            What lies below the foot or above the map does not count.
    """

    cells: Bool[np.ndarray, "r z"]
    margins: Float64[np.ndarray, "r z"]

    def margin(self, distances: Numbers, heights: Numbers) -> Numbers:
        """How far inside the reach points lie, by distance from the base's axis and height. Shape (n,) [m]."""
        row = np.rint(distances / CELL_M).astype(np.int64)
        column = np.clip(np.rint(heights / CELL_M).astype(np.int64), 0, self.cells.shape[1] - 1)
        inside = (row < len(self.cells)) & (heights <= HIGHEST_M)
        return np.where(inside, self.margins[np.minimum(row, len(self.cells) - 1), column], 0.0)


@lru_cache(maxsize=4)
def reach_of(arm: Arm) -> Reach:
    """The map of an arm; arms are told apart by identity, and `arm_of` gives the same one again."""
    solver = _Solver(arm)
    shape = (round(FARTHEST_M / CELL_M) + 1, round(HIGHEST_M / CELL_M) + 1)
    cells = np.zeros(shape, dtype=bool)
    queue = deque(_seeds(solver, shape))
    for row, column, _ in queue:
        cells[row, column] = True
    while queue:
        row, column, joints = queue.popleft()
        for r, c in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if 0 <= r < shape[0] and 0 <= c < shape[1] and not cells[r, c]:
                found = solver.solve(_point(r, c), joints)
                if found is not None:
                    cells[r, c] = True
                    queue.append((r, c, found))
    walled = np.pad(cells, ((1, 1), (0, 0)))  # below and above the map is no border
    return Reach(cells, np.maximum(ndimage.distance_transform_edt(walled, CELL_M)[1:-1], 0.0))


def _point(row: int, column: int) -> Vector3:
    return np.array([row * CELL_M, 0.0, column * CELL_M])


def _seeds(solver: "_Solver", shape: tuple[int, int]) -> list[tuple[int, int, JointVector]]:
    """The cell around the TCP at home, or the nearest thing to it that some start reaches."""
    arm = solver.arm
    tcp = solver.tcp(arm.home)
    row = int(np.clip(round(float(np.hypot(tcp[0], tcp[1])) / CELL_M), 0, shape[0] - 1))
    column = int(np.clip(round(float(tcp[2]) / CELL_M), 0, shape[1] - 1))
    starts = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_RESTARTS, len(arm.home)))
    for near in ((row, column), (row, column // 2), ((row + 10) // 2, column // 2)):
        for start in (arm.home, *starts):
            joints = solver.solve(_point(*near), start)
            if joints is not None:
                return [(*near, joints)]
    return []


class _Solver:
    """Damped least squares on the arm alone, gripper pointing down."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self._model = arm.spec().compile()
        self._data = quiet_data(self._model)
        self._qpos = [int(self._model.joint(name).qposadr[0]) for name in arm.joint_names]
        self._dof = [int(self._model.joint(name).dofadr[0]) for name in arm.joint_names]
        self._site = int(self._model.site(arm.tcp_site).id)
        self._jacobian = np.zeros((6, self._model.nv))

    def tcp(self, joints: JointVector) -> Vector3:
        """Where the TCP is."""
        self._data.qpos[self._qpos] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return np.array(self._data.site_xpos[self._site])

    def solve(self, target: Vector3, start: JointVector) -> JointVector | None:
        """Joints within limits at which the TCP is at the target, or None."""
        arm, joints = self.arm, np.array(start)
        margin = np.minimum(LIMIT_MARGIN_RAD, 0.1 * (arm.upper - arm.lower))
        for _ in range(_ITERATIONS):
            error = np.concatenate([target - self.tcp(joints), self._turn()])
            if float(np.linalg.norm(error)) < _TOLERANCE:
                return joints
            mujoco.mj_comPos(self._model, self._data)
            mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._site)
            jacobian = self._jacobian[:, self._dof]
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING * np.eye(6), error)
            joints = np.clip(joints + step, arm.lower + margin, arm.upper - margin)
        return None

    def _turn(self) -> Vector3:
        """Rotation vector, for small ones, from how the gripper points to straight down."""
        now = self._data.site_xmat[self._site].reshape(3, 3)
        turn: Vector3 = 0.5 * np.cross(now.T, _DOWNWARD.T).sum(axis=0)
        return turn
