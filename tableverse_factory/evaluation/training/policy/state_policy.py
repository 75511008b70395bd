"""Policy on states with trained weights: it draws a grasp and a release, and moves there in chunks."""

from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from schemas.geometry import Pose
from schemas.trajectories import JointVector
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart
from tableverse_factory.evaluation.training.checkpoint import read_weights
from tableverse_factory.evaluation.training.policy.chain import load_chain
from tableverse_factory.evaluation.training.policy.demonstrations import ROWS, STEP_S
from tableverse_factory.evaluation.training.policy.goals import (
    DRAWN_POINTS,
    GRASP_UNIT_M,
    GoalFrame,
    Scenes,
    decode_grasp,
    decode_openings,
    decode_release,
    describe_task,
    find_frame,
    select_points,
)
from tableverse_factory.evaluation.training.policy.motions import (
    MOTION_POINTS,
    RobotState,
    decode_chunk,
    describe_state,
    localize_points,
)
from tableverse_factory.evaluation.training.policy.network import GOAL, make_network
from tableverse_factory.evaluation.training.policy.rotations import (
    apply,
    columns_from_matrix,
    matrix_from_quaternion,
    matrix_from_vector,
    vector_from_matrix,
)
from tableverse_factory.evaluation.training.policy.select import select_goals
from tableverse_factory.evaluation.training.policy.tensors import (
    GRASP,
    PLACE,
    POST_PLACE,
    PRE_GRASP,
    describe_relations,
)
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, matrix_from_pose, pose_from_rotation
from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.robotics.motion.kinematics import solve_ik

torch = import_torch()

DRAWN = 64  # goals of which the densest that the arm reaches is taken
TRIED = 24
EXECUTED = 4  # samples of a chunk
IK_STEPS = 4
RISE_M, LEFT_BEHIND_M = 0.05, 0.01  # X is lost where it has risen by less while the gripper rose by more [m]
WAIT_S = 2.0  # after the release, before another attempt
RETURN_SPEED = 0.8  # of joints on the way home [rad/s]
HOMING = 0.02  # share of the way home that joints go per step where the gripper's pose leaves them free


class StatePolicy:
    """Policy on states; `weights` is the file that training writes."""

    pictures: tuple[str, ...] = ()
    picture_size = (96, 128)

    def __init__(self, weights: str | Path) -> None:
        self._network = make_network(0)
        read_weights(Path(weights), self._network)
        self._network.eval()

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode."""
        self._start, self._chain = start, load_chain(start.robot)
        self._repeats = round(STEP_S / start.step_s)
        if self._repeats < 1 or abs(self._repeats * start.step_s - STEP_S) > 1e-6:
            raise InputError(f"steps of {start.step_s} s: the policy moves in steps of {STEP_S} s, a multiple of them")
        self._random = torch.Generator().manual_seed(start.seed)
        self._base_turn = matrix_from_quaternion(_tensor(start.base.quaternion_wxyz[None]))
        self._base_at = _tensor(start.base.position[None])
        self._queue: deque[np.ndarray] = deque()
        self._home: JointVector | None = None
        self._attempts = 0

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the next command as an action."""
        robot, objects = np.asarray(observation["state"], np.float64), np.asarray(observation["objects"], np.float64)
        with torch.inference_mode():
            if self._home is None:
                self._home = robot[: len(self._chain.lower)].copy()
                self._command = np.array([*self._home, self._start.upper[-1]])
                self._plan(objects)
            if not self._queue and self._has_failed(objects):
                self._return_home()
            elif not self._queue:
                if self._returning:
                    self._plan(objects)
                self._extend_queue(robot, objects)
        self._command = self._queue.popleft()
        self._released_s += self._start.step_s * (self._phase == POST_PLACE)
        return self._start.to_action(self._command)

    def _has_failed(self, objects: np.ndarray) -> bool:
        """Test whether X was left behind, or lies where it was released and that was not what the task asks for."""
        if self._returning:
            return False
        rise = float(self._command_tcp()[0][0, 2] - self._grasp_at[0, 2])
        left = objects[0, 2] - self._stood[0, 2] < LEFT_BEHIND_M and rise > RISE_M and GRASP < self._phase < PLACE
        return bool(left) or self._released_s > WAIT_S

    def _return_home(self) -> None:
        """Append commands that open the fingers and lead home, for another attempt from there."""
        way = self._home - self._command[:-1]
        steps = max(2, int(np.ceil(np.abs(way).max() / (RETURN_SPEED * self._start.step_s))))
        for share in np.arange(1, steps + 1) / steps:
            self._queue.append(np.array([*(self._command[:-1] + share * way), self._start.upper[-1]]))
        self._returning, self._phase, self._released_s = True, PRE_GRASP, 0.0

    def _plan(self, objects: np.ndarray) -> None:
        """Draw a grasp and a release for the scene as it stands."""
        self._phase, self._returning, self._released_s = PRE_GRASP, False, 0.0
        self._stood = objects[: len(self._start.points)]
        self._rows = self._order_objects()
        scenes = self._describe_scene()
        self._grasp_at, self._grasp_turn, self._grasp_fingers = self._draw_grasp(scenes)
        self._draw_release(scenes)
        self._goal = (self._grasp_at, self._grasp_turn)
        self._attempts += 1

    def _order_objects(self) -> list[int]:
        """List X, Y, and the others nearest to X, as demonstrations do."""
        turn = matrix_from_quaternion(_tensor(self._stood[:, 3:]))
        centers = apply(turn[:, None], _tensor(self._start.points)).mean(1) + _tensor(self._stood[:, :3])
        away = (centers - centers[0]).norm(dim=1)
        return [0, 1, *(int(k) for k in away.argsort(stable=True) if k > 1)][:ROWS]

    def _place_points(self, poses: np.ndarray, count: int) -> tuple[Tensor, Tensor]:
        """Place points of the objects in the table frame; (1, ROWS, count, 3), and which objects are there."""
        placed, present = torch.zeros(1, ROWS, count, 3), torch.zeros(1, ROWS, dtype=torch.bool)
        own = _tensor(poses[self._rows])
        points = _tensor(self._start.points[self._rows, :count])
        placed[0, : len(own)] = apply(matrix_from_quaternion(own[:, 3:])[:, None], points) + own[:, None, :3]
        present[0, : len(own)] = True
        return placed, present

    def _describe_scene(self) -> Scenes:
        kind, side = describe_relations([str(self._start.relation)])
        return Scenes(*self._place_points(self._stood, DRAWN_POINTS), self._base_at, self._base_turn, kind, side)

    def _draw(self, scenes: Scenes, release: bool, grasp: Tensor) -> tuple[GoalFrame, Tensor]:
        """Draw goals; return their frame, and them, the densest first, but in later attempts as they were drawn."""
        flag = torch.tensor([release])
        frame = find_frame(scenes, flag, torch.zeros(1), torch.tensor([False]))
        task = describe_task(scenes, frame, flag, grasp)
        memory = self._network.goal.encode(*select_points(scenes, frame), task)
        drawn = self._network.goal.draw(memory, torch.randn(1, DRAWN, GOAL, generator=self._random))
        return frame, drawn if self._attempts else drawn[:, select_goals(drawn)[0]]

    def _draw_grasp(self, scenes: Scenes) -> tuple[Tensor, Tensor, Tensor]:
        frame, drawn = self._draw(scenes, False, torch.zeros(1, 9))
        at, turn = decode_grasp(scenes, frame, drawn)
        best = self._find_reachable(at[0], turn[0])
        position = frame.turn_in(at[:, best] - scenes.middle[:, 0]) / GRASP_UNIT_M
        self._grasp = torch.cat([position, columns_from_matrix(frame.rotation_in(turn[:, best]))], 1)
        return at[:, best], turn[:, best], decode_openings(drawn[:, best])

    def _draw_release(self, scenes: Scenes) -> None:
        """Draw the motion of X, as a rotation about the middle of its points and where that comes to be."""
        flag = torch.tensor([True])
        frame = find_frame(scenes, flag, torch.zeros(1), torch.tensor([False]))
        away = self._grasp_at - scenes.middle[:, 0]
        grasp = torch.cat(
            [frame.turn_in(away) / GRASP_UNIT_M, columns_from_matrix(frame.rotation_in(self._grasp_turn))], 1
        )
        frame, drawn = self._draw(scenes, True, grasp)
        middle, motion = decode_release(frame, drawn)
        at = (motion @ away[:, None, :, None])[..., 0] + middle
        best = self._find_reachable(at[0], (motion @ self._grasp_turn[:, None])[0])
        self._middle = scenes.middle[:, 0]
        self._placed_at, self._placed_turn = middle[:, best], motion[:, best]
        self._release_fingers = torch.cat([decode_openings(drawn[:, best])[:, :1], self._grasp_fingers[:, 1:]], 1)

    def _find_reachable(self, at: Tensor, turn: Tensor) -> int:
        """Find the first pose of the table frame that the arm reaches; the first of all if it reaches none."""
        for k in range(TRIED):
            pose = self._to_base(at[k].double().numpy(), turn[k].double().numpy())
            if len(solve_ik(self._chain, pose, self._command[:-1], 1)):
                return k
        return 0

    def _to_base(self, at: np.ndarray, turn: np.ndarray) -> Pose:
        return compose_poses(invert_pose(self._start.base), pose_from_rotation(at, turn))

    def _extend_queue(self, robot: np.ndarray, objects: np.ndarray) -> None:
        """Compute the next chunk and append the commands of its first samples."""
        state = self._describe_robot(robot, objects)
        mirror = torch.ones(1, 3)
        points, present = self._place_points(objects, MOTION_POINTS)
        points = localize_points(points, state.goal_at, state.goal_turn, mirror)
        chunk = self._network.motion(describe_state(state, mirror), points, present)
        at, turn, opening = decode_chunk(state, chunk)
        self._phase = max(self._phase, int(chunk[0, EXECUTED - 1, 7:].argmax()))
        self._append_commands(
            torch.cat([state.tcp_at[:, None], at], 1)[0], torch.cat([state.tcp_turn[:, None], turn], 1)[0], opening[0]
        )

    def _command_tcp(self) -> tuple[Tensor, Tensor]:
        """Compute the gripper's commanded pose in the table frame."""
        rotation, position = self._chain.forward(self._command[None, :-1])
        return self._base_at + apply(self._base_turn, _tensor(position)), self._base_turn @ _tensor(rotation)

    def _describe_robot(self, robot: np.ndarray, objects: np.ndarray) -> RobotState:
        joints = len(self._chain.lower)
        tcp_at, tcp_turn = self._command_tcp()
        fingers = self._grasp_fingers if self._phase <= GRASP else self._release_fingers
        if GRASP < self._phase < PLACE:
            self._goal = self._locate_release(robot[2 * joints + 1 :], objects[0])
        return RobotState(
            tcp_at,
            tcp_turn,
            _tensor(np.array([[self._command[-1], robot[2 * joints]]])),
            *self._goal,
            fingers,
            torch.tensor([self._phase]),
            torch.zeros(1, 3) if self._phase <= GRASP else tcp_at - self._grasp_at,
            self._base_at,
            self._base_turn,
        )

    def _locate_release(self, tcp: np.ndarray, carried: np.ndarray) -> tuple[Tensor, Tensor]:
        """Locate the gripper that lets X go where it was drawn, as X now lies between the fingers."""
        tcp_turn, now = (
            matrix_from_quaternion(_tensor(tcp[None, 3:])),
            matrix_from_quaternion(_tensor(carried[None, 3:])),
        )
        stood = matrix_from_quaternion(_tensor(self._stood[:1, 3:]))
        to_stood = stood @ now.mT  # X as it stood, from X as it is
        at = apply(to_stood, _tensor(tcp[None, :3] - carried[None, :3])) + _tensor(self._stood[:1, :3])
        turned = apply(self._placed_turn, at - self._middle) + self._placed_at
        return turned, self._placed_turn @ to_stood @ tcp_turn

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
                width = fingers + share * (float(opening[k]) - fingers)
                self._queue.append(np.array([*q, width]))
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


def _tensor(array: np.ndarray) -> Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32)
