"""Reach map of a downward-pointing gripper over distance from the base's axis and height above its foot.

Computed once per arm by inverse kinematics that spreads from cell to cell, each starting from its neighbor's joints.
It serves to choose a base and does not guarantee that grasps from other directions are reached.
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
from tableverse_factory.physics.simulate.at_rest import make_quiet_data
from tableverse_factory.robotics.robots.arm import Arm

CELL_M = 0.05
MAX_DISTANCE_M, MAX_HEIGHT_M = 1.5, 0.8
LIMIT_MARGIN_RAD = 0.1  # distance kept from joint stops, so that a reached pose leaves room to move on
_DOWNWARD = np.diag([1.0, -1.0, -1.0])
_ITERATIONS, _RESTARTS = 30, 16
_TOLERANCE, _DAMPING = 1e-3, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class ReachMap(Frozen):
    """Map of cells of `CELL_M`, the first around distance 0 and height 0: rows are distances, columns heights.

    Margins are distances of reached cells to the nearest unreached one [m], else 0; the border above and below is none.
    """

    cells: Bool[np.ndarray, "r z"]
    margins: Float64[np.ndarray, "r z"]

    def margin(self, distances: Numbers, heights: Numbers) -> Numbers:
        """Look up how far inside the reach points lie, by distance from the base's axis and height. Shape (n,) [m]."""
        row = np.rint(distances / CELL_M).astype(np.int64)
        column = np.clip(np.rint(heights / CELL_M).astype(np.int64), 0, self.cells.shape[1] - 1)
        inside = (row < len(self.cells)) & (heights <= MAX_HEIGHT_M)
        return np.where(inside, self.margins[np.minimum(row, len(self.cells) - 1), column], 0.0)


@lru_cache(maxsize=4)
def compute_reach_map(arm: Arm) -> ReachMap:
    """Compute an arm's map, cached by identity (`load_arm` returns the same arm for the same name)."""
    solver = _IkSolver(arm)
    shape = (round(MAX_DISTANCE_M / CELL_M) + 1, round(MAX_HEIGHT_M / CELL_M) + 1)
    cells = np.zeros(shape, dtype=bool)
    queue = deque(_find_seeds(solver, shape))
    for row, column, _ in queue:
        cells[row, column] = True
    while queue:
        row, column, joints = queue.popleft()
        for r, c in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if 0 <= r < shape[0] and 0 <= c < shape[1] and not cells[r, c]:
                found = solver.solve(_cell_center(r, c), joints)
                if found is not None:
                    cells[r, c] = True
                    queue.append((r, c, found))
    walled = np.pad(cells, ((1, 1), (0, 0)))  # below and above the map is no border
    return ReachMap(cells, np.maximum(ndimage.distance_transform_edt(walled, CELL_M)[1:-1], 0.0))


def _cell_center(row: int, column: int) -> Vector3:
    return np.array([row * CELL_M, 0.0, column * CELL_M])


def _find_seeds(solver: "_IkSolver", shape: tuple[int, int]) -> list[tuple[int, int, JointVector]]:
    """Find the cell around the TCP at home, or the nearest one that some start reaches."""
    arm = solver.arm
    tcp = solver.tcp(arm.home)
    row = int(np.clip(round(float(np.hypot(tcp[0], tcp[1])) / CELL_M), 0, shape[0] - 1))
    column = int(np.clip(round(float(tcp[2]) / CELL_M), 0, shape[1] - 1))
    starts = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_RESTARTS, len(arm.home)))
    for near in ((row, column), (row, column // 2), ((row + 10) // 2, column // 2)):
        for start in (arm.home, *starts):
            joints = solver.solve(_cell_center(*near), start)
            if joints is not None:
                return [(*near, joints)]
    return []


class _IkSolver:
    """Damped least squares on the arm alone, gripper pointing down."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self._model = arm.spec().compile()
        self._data = make_quiet_data(self._model)
        self._qpos = [int(self._model.joint(name).qposadr[0]) for name in arm.joint_names]
        self._dof = [int(self._model.joint(name).dofadr[0]) for name in arm.joint_names]
        self._site = int(self._model.site(arm.tcp_site).id)
        self._jacobian = np.zeros((6, self._model.nv))

    def tcp(self, joints: JointVector) -> Vector3:
        """Compute the TCP's position."""
        self._data.qpos[self._qpos] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return np.array(self._data.site_xpos[self._site])

    def solve(self, target: Vector3, start: JointVector) -> JointVector | None:
        """Find joints within limits that put the TCP at the target."""
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
        """Compute the small-angle rotation vector from the gripper's direction to straight down."""
        now = self._data.site_xmat[self._site].reshape(3, 3)
        return 0.5 * np.cross(now.T, _DOWNWARD.T).sum(axis=0)
