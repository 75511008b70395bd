"""Policy that draws goals about points of X, of Y and of what else stands about them."""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from schemas.trajectories import Grasps
from tableverse_factory.evaluation.training.policy.chunk_policy import ChunkPolicy, Observation
from tableverse_factory.evaluation.training.policy.goals import (
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
from tableverse_factory.evaluation.training.policy.rotations import apply
from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS
from tableverse_factory.robotics.grasps.clearance import find_clear_grasps
from tableverse_factory.robotics.robots.gripper_clearance import FINGER_CLEARANCE_M, LIFT_M, STANDOFF_M
from tableverse_factory.robotics.robots.registry import load_arm

torch = import_torch()

PLACED_POINTS = 96  # of X, that are kept away from others
ROOM_M = 0.008  # between points of X and of others


@dataclass(frozen=True, slots=True)
class Look:
    """Scene as a policy sees it: what the network is told, and points that are kept clear of, in the table frame."""

    scenes: Scenes  # one
    x: Tensor  # its surface, (p, 3) [m]
    body: Tensor  # X as it is carried
    y: Tensor
    others: Tensor


class ObjectPolicy(ChunkPolicy):
    """Policy that draws a grasp and a release of X from a look at the scene."""

    @abstractmethod
    def look(self, observation: Observation) -> Look:
        """Look at the scene with the arm at home."""

    def plan(self, observation: Observation) -> None:
        """Draw a grasp and a release for the scene as it stands."""
        self._look = self.look(observation)
        self._draw_grasp()
        self._draw_release()

    def _draw(self, release: bool, grasp: tuple[Tensor, Tensor]) -> tuple[GoalFrame, Tensor]:
        """Draw goals; return their frame too."""
        scenes, flag = self._look.scenes, torch.tensor([release])
        frame = find_frame(scenes, flag, torch.zeros(1), torch.tensor([False]))
        task = describe_task(scenes, frame, flag, describe_grasp(scenes, frame, *grasp))
        memory = self._network.goal.encode(*select_points(scenes, frame), task)
        return frame, self.draw_goals(memory)

    def _draw_grasp(self) -> None:
        seen, scenes = self._look, self._look.scenes
        frame, drawn = self._draw(False, (scenes.middle[:, 0], torch.eye(3)[None]))
        at, turn = decode_grasp(scenes, frame, drawn)
        around = torch.cat([seen.x, seen.y, seen.others])
        clear = self._find_clear(at[0], turn[0], decode_openings(drawn[0])[:, 0], around)
        best = self.find_reachable(at[0], turn[0], -STANDOFF_M * turn[0, :, :, 2], clear)
        self._grasp_at, self._grasp_turn = at[:, best], turn[:, best]
        self._grasp_fingers = decode_openings(drawn[:, best])

    def _find_clear(self, at: Tensor, turn: Tensor, opening: Tensor, around: Tensor) -> np.ndarray:
        """Test which poses keep the open gripper, on its straight way too, clear of the table and of points.

        Shapes (m, 3), (m, 3, 3), (m,) and (n, 3).
        """
        arm = load_arm(self._start.robot)
        widths = opening.double().numpy() - 2 * FINGER_CLEARANCE_M
        grasps = Grasps(turn.double().numpy(), at.double().numpy(), widths, np.ones(len(at)))
        return find_clear_grasps(grasps, arm.shape, arm.max_opening_m, around.double().numpy(), ())

    def _find_free(self, middle: Tensor, motion: Tensor) -> np.ndarray:
        """Test which motions of X, as `_draw_release` has them, keep its points away from those of all others.

        X may touch what will carry it. Shapes (m, 3) and (m, 3, 3).
        """
        seen, carries = self._look, self._start.relation in RESTING_RELATIONS
        others = seen.others if carries else torch.cat([seen.y, seen.others])
        if not len(others):
            return np.ones(len(middle), dtype=bool)
        body = seen.body[:: max(1, -(-len(seen.body) // PLACED_POINTS))]
        moved = apply(motion[:, None], body - self._middle) + middle[:, None]
        away = torch.cdist(moved.reshape(-1, 3), others).reshape(len(middle), -1)
        return (away > ROOM_M).all(1).numpy()

    def _draw_release(self) -> None:
        """Draw the motion of X, as a rotation about the middle of its points and where that comes to be."""
        seen = self._look
        frame, drawn = self._draw(True, (self._grasp_at, self._grasp_turn))
        middle, motion = decode_release(frame, drawn)
        self._middle = seen.scenes.middle[:, 0]
        at = (motion @ (self._grasp_at - self._middle)[:, None, :, None])[..., 0] + middle
        turn = (motion @ self._grasp_turn[:, None])[0]
        around, opening = torch.cat([seen.y, seen.others]), decode_openings(drawn[0])[:, 0]
        wanted = self._find_free(middle[0], motion[0]) & self._find_clear(at[0], turn, opening, around)
        best = self.find_reachable(at[0], turn, torch.tensor([0.0, 0.0, LIFT_M]), wanted)
        self._placed_at, self._placed_turn = middle[:, best], motion[:, best]
        self._release_fingers = torch.cat([decode_openings(drawn[:, best])[:, :1], self._grasp_fingers[:, 1:]], 1)
