"""Baseline `random`: targets drawn at random."""

from collections.abc import Mapping

import numpy as np

from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart

HOLD_STEPS = 25  # a target is kept for half a second, as targets that change at every step cancel out


class RandomPolicy:
    """Policy that draws a target of all joints and the gripper every half second."""

    pictures: tuple[str, ...] = ()
    picture_size = (96, 128)

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode."""
        self._rng, self._length = make_rng(start.seed, start.episode_id, "random policy"), len(start.lower)
        self._step, self._action = 0, np.zeros(self._length)

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:  # noqa: ARG002 it looks at nothing
        """Draw a target, or keep the last one."""
        if self._step % HOLD_STEPS == 0:
            self._action = self._rng.uniform(-1.0, 1.0, self._length)
        self._step += 1
        return self._action
