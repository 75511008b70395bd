"""Policy on states: it sees the poses of the objects, and points on their surfaces."""

from pathlib import Path

import numpy as np

from tableverse_factory.evaluation.training.policy.chunk_policy import Observation, to_tensor
from tableverse_factory.evaluation.training.policy.demonstrations import ROWS
from tableverse_factory.evaluation.training.policy.goals import DRAWN_POINTS, Scenes
from tableverse_factory.evaluation.training.policy.motions import MOTION_POINTS
from tableverse_factory.evaluation.training.policy.network import make_network
from tableverse_factory.evaluation.training.policy.object_policy import PLACED_POINTS, Look, ObjectPolicy
from tableverse_factory.evaluation.training.policy.rotations import apply, matrix_from_quaternion
from tableverse_factory.evaluation.training.policy.shipped import SHIPPED
from tableverse_factory.evaluation.training.policy.tensors import describe_relations
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

LEFT_BEHIND_M = 0.01  # rise of X below which it was not lifted


class StatePolicy(ObjectPolicy):
    """Policy on states; `weights` is the file that training writes, by default that of the package."""

    def __init__(self, weights: str | Path | None = None) -> None:
        super().__init__(make_network(0), weights, SHIPPED["state"])

    def look(self, observation: Observation) -> Look:
        """Place the points of the objects where they stand."""
        self._stood = self._read_poses(observation)
        self._rows = self._order_objects()
        kind, side = describe_relations([str(self._start.relation)])
        points = self._place_points(self._stood, DRAWN_POINTS)
        scenes = Scenes(*points, self._base_at, self._base_turn, kind, side)
        turns = matrix_from_quaternion(to_tensor(self._stood[:, 3:]))[:, None]
        placed = apply(turns, to_tensor(self._start.points)) + to_tensor(self._stood[:, None, :3])
        return Look(scenes, placed[0], placed[0][:PLACED_POINTS], placed[1], placed[2:].reshape(-1, 3))

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
