"""Policy on states: it sees the poses of the objects, and points on their surfaces."""

from pathlib import Path

import numpy as np

from schemas.trajectories import Grasps
from tableverse_factory.evaluation.training.policy.chunk_policy import ChunkPolicy, Observation, to_tensor
from tableverse_factory.evaluation.training.policy.demonstrations import ROWS
from tableverse_factory.evaluation.training.policy.goals import (
    DRAWN_POINTS,
    GoalFrame,
    Scenes,
    decode_grasp,
    decode_openings,
    decode_release,
    describe_grasp,
    describe_task,
    find_frame,
    select_points,
)
from tableverse_factory.evaluation.training.policy.motions import MOTION_POINTS
from tableverse_factory.evaluation.training.policy.network import make_network
from tableverse_factory.evaluation.training.policy.rotations import apply, matrix_from_quaternion
from tableverse_factory.evaluation.training.policy.tensors import describe_relations
from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.models.local.shipped_weights import read_shipped
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS
from tableverse_factory.robotics.grasps.clearance import find_clear_grasps
from tableverse_factory.robotics.robots.gripper_clearance import FINGER_CLEARANCE_M, LIFT_M, STANDOFF_M
from tableverse_factory.robotics.robots.registry import load_arm

torch = import_torch()

SHIPPED = Path(__file__).with_name("state.safetensors")

PLACED_POINTS = 96  # of X, that are kept away from others
ROOM_M = 0.008  # between points of X and of others
LEFT_BEHIND_M = 0.01  # rise of X below which it was not lifted


class StatePolicy(ChunkPolicy):
    """Policy on states; `weights` is the file that training writes."""

    def __init__(self, weights: str | Path | None = None) -> None:
        """Load weights from a file, or those of the package."""
        if weights is None:
            read_shipped(SHIPPED, SHIPPED.with_suffix(".sha256"))
        super().__init__(make_network(0), weights or SHIPPED)

    def plan(self, observation: Observation) -> None:
        """Draw a grasp and a release for the scene as it stands."""
        self._stood = self._read_poses(observation)
        self._rows = self._order_objects()
        kind, side = describe_relations([str(self._start.relation)])
        points = self._place_points(self._stood, DRAWN_POINTS)
        scenes = Scenes(*points, self._base_at, self._base_turn, kind, side)
        self._draw_grasp(scenes)
        self._draw_release(scenes)

    def _read_poses(self, observation: Observation) -> np.ndarray:
        """Read the pose of each object, X and Y first. Shape (n, 7)."""
        return np.asarray(observation["objects"], np.float64)[: len(self._start.points)]

    def _order_objects(self) -> list[int]:
        """List X, Y, and the others nearest to X, as demonstrations do."""
        turn = matrix_from_quaternion(to_tensor(self._stood[:, 3:]))
        centers = apply(turn[:, None], to_tensor(self._start.points)).mean(1) + to_tensor(self._stood[:, :3])
        away = (centers - centers[0]).norm(dim=1)
        return [0, 1, *(int(k) for k in away.argsort(stable=True) if k > 1)][:ROWS]

    def _place_points(self, poses: np.ndarray, count: int) -> tuple[Tensor, Tensor]:
        """Place points of the objects in the table frame; (1, ROWS, count, 3), and which objects are there."""
        placed, present = torch.zeros(1, ROWS, count, 3), torch.zeros(1, ROWS, dtype=torch.bool)
        own = to_tensor(poses[self._rows])
        points = to_tensor(self._start.points[self._rows, :count])
        placed[0, : len(own)] = apply(matrix_from_quaternion(own[:, 3:])[:, None], points) + own[:, None, :3]
        present[0, : len(own)] = True
        return placed, present

    def _draw(self, scenes: Scenes, release: bool, grasp: tuple[Tensor, Tensor]) -> tuple[GoalFrame, Tensor]:
        """Draw goals; return their frame too."""
        flag = torch.tensor([release])
        frame = find_frame(scenes, flag, torch.zeros(1), torch.tensor([False]))
        task = describe_task(scenes, frame, flag, describe_grasp(scenes, frame, *grasp))
        memory = self._network.goal.encode(*select_points(scenes, frame), task)
        return frame, self.draw_goals(memory)

    def _draw_grasp(self, scenes: Scenes) -> None:
        none = scenes.middle[:, 0], torch.eye(3)[None]
        frame, drawn = self._draw(scenes, False, none)
        at, turn = decode_grasp(scenes, frame, drawn)
        clear = self._find_clear(at[0], turn[0], decode_openings(drawn[0])[:, 0])
        best = self.find_reachable(at[0], turn[0], -STANDOFF_M * turn[0, :, :, 2], clear)
        self._grasp_at, self._grasp_turn = at[:, best], turn[:, best]
        self._grasp_fingers = decode_openings(drawn[:, best])

    def _find_clear(self, at: Tensor, turn: Tensor, opening: Tensor, first: int = 0) -> np.ndarray:
        """Test which poses keep the open gripper, on its straight way too, clear of the table and of what is seen.

        Points of the objects from `first` on are seen. Shapes (m, 3), (m, 3, 3) and (m,).
        """
        arm, seen = load_arm(self._start.robot), self._place_all()[first:].reshape(-1, 3).double().numpy()
        widths = opening.double().numpy() - 2 * FINGER_CLEARANCE_M
        grasps = Grasps(turn.double().numpy(), at.double().numpy(), widths, np.ones(len(at)))
        return find_clear_grasps(grasps, arm.shape, arm.max_opening_m, seen, ())

    def _place_all(self) -> Tensor:
        """Place all points of all objects where they stood. Shape (n, p, 3)."""
        turns = matrix_from_quaternion(to_tensor(self._stood[:, 3:]))[:, None]
        return apply(turns, to_tensor(self._start.points)) + to_tensor(self._stood[:, None, :3])

    def _find_free(self, middle: Tensor, motion: Tensor) -> np.ndarray:
        """Test which motions of X, as `_draw_release` has them, keep its points away from those of all others.

        Where X is to rest on or in Y, Y is none of them. Shapes (m, 3) and (m, 3, 3).
        """
        placed = self._place_all()
        carries = self._start.relation in RESTING_RELATIONS
        others = placed[2 if carries else 1 :].reshape(-1, 3)
        moved = apply(motion[:, None], placed[0, :PLACED_POINTS] - self._middle) + middle[:, None]
        away = torch.cdist(moved.reshape(-1, 3), others).reshape(len(middle), -1)
        return (away > ROOM_M).all(1).numpy()

    def _draw_release(self, scenes: Scenes) -> None:
        """Draw the motion of X, as a rotation about the middle of its points and where that comes to be."""
        frame, drawn = self._draw(scenes, True, (self._grasp_at, self._grasp_turn))
        middle, motion = decode_release(frame, drawn)
        self._middle = scenes.middle[:, 0]
        at = (motion @ (self._grasp_at - self._middle)[:, None, :, None])[..., 0] + middle
        turn = (motion @ self._grasp_turn[:, None])[0]
        wanted = self._find_free(middle[0], motion[0]) & self._find_clear(
            at[0], turn, decode_openings(drawn[0])[:, 0], 1
        )
        best = self.find_reachable(at[0], turn, torch.tensor([0.0, 0.0, LIFT_M]), wanted)
        self._placed_at, self._placed_turn = middle[:, best], motion[:, best]
        self._release_fingers = torch.cat([decode_openings(drawn[:, best])[:, :1], self._grasp_fingers[:, 1:]], 1)

    def locate_release(self, observation: Observation, tcp: np.ndarray) -> tuple[Tensor, Tensor]:
        """Locate the gripper that lets X go where it was drawn, as X now lies between the fingers."""
        carried, stood = self._read_poses(observation)[:1], self._stood[:1]
        turns = [matrix_from_quaternion(to_tensor(each[:, 3:])) for each in (tcp[None], carried, stood)]
        to_stood = turns[2] @ turns[1].mT  # X as it stood, from X as it is
        at = apply(to_stood, to_tensor(tcp[None, :3] - carried[:, :3])) + to_tensor(stood[:, :3])
        return apply(self._placed_turn, at - self._middle) + self._placed_at, self._placed_turn @ to_stood @ turns[0]

    def see_objects(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """Place a few points of each object where it is."""
        return self._place_points(self._read_poses(observation), MOTION_POINTS)

    def is_left_behind(self, observation: Observation) -> bool:
        """Test whether X did not rise."""
        return bool(self._read_poses(observation)[0, 2] - self._stood[0, 2] < LEFT_BEHIND_M)
