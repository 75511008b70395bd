"""Policy that draws a grasp and a release, and moves there in chunks; what it sees is left to its subclasses."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from schemas.geometry import Pose
from schemas.trajectories import JointVector
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart
from tableverse_factory.evaluation.training.checkpoint import read_weights
from tableverse_factory.evaluation.training.policy.chain import load_chain
from tableverse_factory.evaluation.training.policy.demonstrations import STEP_S
from tableverse_factory.evaluation.training.policy.motions import (
    RobotState,
    decode_chunk,
    describe_state,
    localize_points,
)
from tableverse_factory.evaluation.training.policy.network import GOAL
from tableverse_factory.evaluation.training.policy.rotations import (
    apply,
    matrix_from_quaternion,
    matrix_from_vector,
    vector_from_matrix,
)
from tableverse_factory.evaluation.training.policy.select import select_goals
from tableverse_factory.evaluation.training.policy.tensors import GRASP, PLACE, POST_PLACE, PRE_GRASP
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, matrix_from_pose, pose_from_rotation
from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.models.local.shipped_weights import read_shipped
from tableverse_factory.robotics.motion.kinematics import solve_ik

torch = import_torch()

DRAWN = 128  # goals of which the densest that the arm reaches is taken
TRIED = 24
EXECUTED = 4  # samples of a chunk
IK_STEPS = 4
RISE_M = 0.05  # of the gripper after the grasp, from which it is known whether X came along
WAIT_S = 2.0  # after the release, before another attempt
RETURN_SPEED = 0.8  # of joints on the way home [rad/s]
STILL_RAD, STILL_OPENING_M, STILL_CHUNKS = 0.015, 0.001, 3  # change within a chunk, and chunks, of a standstill
MAX_TURN_RAD = 1.0  # of a joint along a straight way
HOMING = 0.02  # share of the way home that joints go per step where the gripper's pose leaves them free

Observation = Mapping[str, np.ndarray]


class ChunkPolicy(ABC):
    """Policy that moves in chunks; `network` has the parts `goal` and `motion`."""

    pictures: tuple[str, ...] = ()
    picture_size = (96, 128)

    def __init__(self, network: Any, weights: str | Path | None, shipped: Path) -> None:
        """Load the file that training wrote, or without one the `shipped` weights of the package."""
        if weights is None:
            read_shipped(shipped, shipped.with_suffix(".sha256"))
        read_weights(Path(weights or shipped), network)
        self._network = network.eval()

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode."""
        self._start, self._chain = start, load_chain(start.robot)
        self._repeats = round(STEP_S / start.step_s)
        if self._repeats < 1 or abs(self._repeats * start.step_s - STEP_S) > 1e-6:
            raise InputError(f"steps of {start.step_s} s: the policy moves in steps of {STEP_S} s, a multiple of them")
        self._random = torch.Generator().manual_seed(start.seed)
        self._base_turn = matrix_from_quaternion(to_tensor(start.base.quaternion_wxyz[None]))
        self._base_at = to_tensor(start.base.position[None])
        self._queue: deque[np.ndarray] = deque()
        self._home: JointVector | None = None
        self._attempts = 0

    def act(self, observation: Observation) -> np.ndarray:
        """Return the next command as an action."""
        robot = np.asarray(observation["state"], np.float64)
        with torch.inference_mode():
            if self._home is None:
                self._home = robot[: len(self._chain.lower)].copy()
                self._command = np.array([*self._home, self._start.upper[-1]])
                self._begin_attempt(observation)
            if not self._queue and self._has_failed(observation):
                self._return_home()
            elif not self._queue:
                if self._returning:
                    self._begin_attempt(observation)
                self._extend_queue(observation, robot)
        self._command = self._queue.popleft()
        self._released_s += self._start.step_s * (self._phase == POST_PLACE)
        return self._start.to_action(self._command)

    @abstractmethod
    def plan(self, observation: Observation) -> None:
        """Draw the grasp and the release, and set what follows from them: the four that are declared here."""

    _grasp_at: Tensor  # (1, 3) in the table frame [m]
    _grasp_turn: Tensor  # (1, 3, 3)
    _grasp_fingers: Tensor  # openings on the way and while holding, (1, 2) [m]
    _release_fingers: Tensor

    @abstractmethod
    def locate_release(self, observation: Observation, tcp: np.ndarray) -> tuple[Tensor, Tensor]:
        """Locate the gripper's pose of the release, (1, 3) and (1, 3, 3); `tcp` is its measured pose, (7,)."""

    @abstractmethod
    def see_objects(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Return points of the objects in the table frame, (1, r, p, 3), and which are there, (1, r)."""

    @abstractmethod
    def is_left_behind(self, observation: Observation) -> bool:
        """Test whether X is not between the fingers, which have just lifted it."""

    def draw_goals(self, memory: tuple[Tensor, Tensor]) -> Tensor:
        """Draw goals, (1, m, GOAL), the densest first, but in later attempts as they are drawn."""
        drawn = self._network.goal.draw(memory, torch.randn(1, DRAWN, GOAL, generator=self._random))
        return drawn if self._attempts else drawn[:, select_goals(drawn)[0]]

    def find_reachable(self, at: Tensor, turn: Tensor, way: Tensor, wanted: np.ndarray | None = None) -> int:
        """Find the first pose of the table frame that the arm reaches, the `wanted` ones first; else return the first.

        It has to reach the other end of its straight way too, without another posture. Shapes (m, 3), (m, 3, 3),
        (m, 3) [m] and (m,).
        """
        order = np.arange(len(at)) if wanted is None else np.argsort(~wanted, kind="stable")
        places, turns, ends = (each.double().numpy() for each in (at, turn, at + way))
        for k in order[:TRIED].tolist():
            near = solve_ik(self._chain, self._to_base(places[k], turns[k]), self._command[:-1], 1)
            far = solve_ik(self._chain, self._to_base(ends[k], turns[k]), near[0], 1) if len(near) else near
            if len(far) and np.abs(far[0] - near[0]).max() < MAX_TURN_RAD:
                return int(k)
        return int(order[0])

    def _begin_attempt(self, observation: Observation) -> None:
        self._phase, self._since_s, self._still = PRE_GRASP, 0.0, 0
        self._returning, self._released_s = False, 0.0
        self.plan(observation)
        self._goal = (self._grasp_at, self._grasp_turn)
        self._attempts += 1

    def _has_failed(self, observation: Observation) -> bool:
        """Test whether X was left behind, or lies where it was released and that was not what the task asks for."""
        if self._returning:
            return False
        rise = float(self._command_tcp()[0][0, 2] - self._grasp_at[0, 2])
        lifting = GRASP < self._phase < PLACE and rise > RISE_M
        return (lifting and self.is_left_behind(observation)) or self._released_s > WAIT_S

    def _return_home(self) -> None:
        """Append commands that open the fingers and lead home, for another attempt from there."""
        way = self._home - self._command[:-1]
        steps = max(2, int(np.ceil(np.abs(way).max() / (RETURN_SPEED * self._start.step_s))))
        for share in np.arange(1, steps + 1) / steps:
            self._queue.append(np.array([*(self._command[:-1] + share * way), self._start.upper[-1]]))
        self._returning, self._phase, self._released_s = True, PRE_GRASP, 0.0

    def _to_base(self, at: np.ndarray, turn: np.ndarray) -> Pose:
        return compose_poses(invert_pose(self._start.base), pose_from_rotation(at, turn))

    def _extend_queue(self, observation: Observation, robot: np.ndarray) -> None:
        """Compute the next chunk and append the commands of its first samples."""
        state = self._describe_robot(observation, robot)
        mirror = torch.ones(1, 3)
        points, present = self.see_objects(observation)
        points = localize_points(points, state.goal_at, state.goal_turn, mirror)
        chunk = self._network.motion(describe_state(state, mirror), points, present)
        at, turn, opening = decode_chunk(state, chunk)
        self._advance_phase(chunk[0, :EXECUTED, 7:].argmax(1).tolist())
        self._append_commands(
            torch.cat([state.tcp_at[:, None], at], 1)[0], torch.cat([state.tcp_turn[:, None], turn], 1)[0], opening[0]
        )
        self._end_standstill()

    def _advance_phase(self, phases: list[int]) -> None:
        """Advance the phase, and the time since it began, by the samples that are executed next."""
        for phase in phases:
            self._since_s += STEP_S
            if phase > self._phase:
                self._phase, self._since_s = phase, 0.0

    def _end_standstill(self) -> None:
        """Advance the phase where the gripper stands still for longer than any demonstration does."""
        change = np.abs(self._queue[-1] - self._command)
        still = change[:-1].max() < STILL_RAD and change[-1] < STILL_OPENING_M
        self._still = self._still + 1 if still else 0
        if self._still >= STILL_CHUNKS and self._phase < POST_PLACE:
            self._phase, self._since_s, self._still = self._phase + 1, 0.0, 0

    def _command_tcp(self) -> tuple[Tensor, Tensor]:
        """Compute the gripper's commanded pose in the table frame."""
        rotation, position = self._chain.forward(self._command[None, :-1])
        return self._base_at + apply(self._base_turn, to_tensor(position)), self._base_turn @ to_tensor(rotation)

    def _describe_robot(self, observation: Observation, robot: np.ndarray) -> RobotState:
        joints = len(self._chain.lower)
        tcp_at, tcp_turn = self._command_tcp()
        if GRASP < self._phase < PLACE:
            self._goal = self.locate_release(observation, robot[2 * joints + 1 :])
        grasping = self._phase <= GRASP
        return RobotState(
            tcp_at,
            tcp_turn,
            to_tensor(np.array([[self._command[-1], robot[2 * joints]]])),
            *self._goal,
            self._grasp_fingers if grasping else self._release_fingers,
            torch.tensor([self._phase]),
            torch.zeros(1, 3) if grasping else tcp_at - self._grasp_at,
            torch.tensor([self._since_s]),
            self._base_at,
            self._base_turn,
        )

    def _append_commands(self, at: Tensor, turn: Tensor, opening: Tensor) -> None:
        """Append commands for the first samples after the present pose, which comes first in `at` and `turn`."""
        q, fingers = self._command[:-1].copy(), float(self._command[-1])
        for k in range(EXECUTED):
            between = vector_from_matrix(turn[k + 1] @ turn[k].mT)
            for part in range(1, self._repeats + 1):
                share = part / self._repeats
                position = at[k] + share * (at[k + 1] - at[k])
                rotation = matrix_from_vector(share * between) @ turn[k]
                q = self._follow(q, self._to_base(position.double().numpy(), rotation.double().numpy()))
                self._queue.append(np.array([*q, fingers + share * (float(opening[k]) - fingers)]))
            fingers = float(opening[k])

    def _follow(self, q: JointVector, target: Pose) -> JointVector:
        """Compute joints for a pose near that of the present ones."""
        chain, matrix, row = self._chain, matrix_from_pose(target), q[None]
        for step in range(IK_STEPS):
            pull = HOMING * (self._home - row) if step == 0 else np.zeros_like(row)
            change, there = chain.step(row, matrix, pull)
            if there.all() and step:
                break
            row = np.clip(row + change, chain.lower, chain.upper)
        return row[0]


def to_tensor(array: np.ndarray) -> Tensor:
    """Convert an array to single precision."""
    return torch.tensor(np.asarray(array), dtype=torch.float32)
