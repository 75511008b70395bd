"""Policy on pictures: it sees the front and the wrist camera, its own joints and fingers, and reads the instruction."""

from pathlib import Path

import numpy as np

from tableverse_factory.core.errors import ConfigError
from tableverse_factory.evaluation.training.policy.chunk_policy import ChunkPolicy, Observation
from tableverse_factory.evaluation.training.policy.demonstrations import ROWS
from tableverse_factory.evaluation.training.policy.first_pictures import CAMERAS, SIZE, number_words
from tableverse_factory.evaluation.training.policy.goals import decode_openings
from tableverse_factory.evaluation.training.policy.motions import MOTION_POINTS
from tableverse_factory.evaluation.training.policy.picture_goals import GRASP, decode_pose, make_picture_network
from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.robotics.robots.gripper_clearance import LIFT_M, STANDOFF_M

torch = import_torch()

EMPTY_M = 0.003  # opening of fingers that hold nothing


class PicturePolicy(ChunkPolicy):
    """Policy on pictures, which it looks at when it is at home; `weights` is the file that training writes."""

    pictures = CAMERAS
    picture_size = SIZE

    def __init__(self, weights: str | Path | None = None) -> None:
        if weights is None:
            raise ConfigError(
                "the policy picture needs weights: give what `tableverse train policy` wrote as --weights"
            )
        super().__init__(make_picture_network(0), weights)

    def plan(self, observation: Observation) -> None:
        """Draw a grasp and a release from the pictures."""
        pictures = np.stack([observation[camera] for camera in CAMERAS]).transpose(0, 3, 1, 2)
        seen = torch.tensor(pictures[None], dtype=torch.float32) / 255
        words = torch.tensor(number_words(self._start.instruction)[None].astype(np.int64))
        self._grasp_at, self._grasp_turn, grasp = self._draw(seen, words, False, torch.zeros(1, GRASP))
        place_at, place_turn, place = self._draw(seen, words, True, grasp[:, :GRASP])
        self._place = (place_at, place_turn)
        self._grasp_fingers = decode_openings(grasp)
        self._release_fingers = torch.cat([decode_openings(place)[:, :1], self._grasp_fingers[:, 1:]], 1)

    def _draw(self, seen: Tensor, words: Tensor, release: bool, grasp: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw a goal that the arm reaches: the gripper's pose in the table frame, and the goal itself."""
        drawn = self.draw_goals(self._network.goal.encode(seen, words, torch.tensor([release]), grasp))
        at, turn = decode_pose((self._base_at, self._base_turn), drawn)
        way = torch.tensor([0.0, 0.0, LIFT_M]) if release else -STANDOFF_M * turn[0, :, :, 2]
        best = self.find_reachable(at[0], turn[0], way)
        return at[:, best], turn[:, best], drawn[:, best]

    def locate_release(self, _observation: Observation, _tcp: np.ndarray) -> tuple[Tensor, Tensor]:
        """Return the pose that was drawn."""
        return self._place

    def see_objects(self, _observation: Observation) -> tuple[Tensor, Tensor]:
        """Return no objects."""
        return torch.zeros(1, ROWS, MOTION_POINTS, 3), torch.zeros(1, ROWS, dtype=torch.bool)

    def is_left_behind(self, observation: Observation) -> bool:
        """Test whether the fingers have closed on nothing."""
        return bool(observation["state"][2 * len(self._chain.lower)] < EMPTY_M)
