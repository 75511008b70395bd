"""Entry of LeRobot's EnvHub: environments of a dataset, with observations by LeRobot's names.

An `env.py` in a repository of the Hub is three lines: docs/simulators.md#lerobots-envhub.
"""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from tableverse_factory.delivery.learning.dataset_environment import make_environment


class LeRobotObservation(gymnasium.ObservationWrapper[dict[str, Any], np.ndarray, dict[str, np.ndarray]]):  # type: ignore[misc]
    """What LeRobot expects of an environment: `agent_pos`, `environment_state` (all objects, flat), and `pixels`.

    These become `observation.state`, `observation.environment_state` and `observation.images.NAME`, as in an export.
    """

    def __init__(self, env: gymnasium.Env[dict[str, np.ndarray], np.ndarray]) -> None:
        """Wrap an environment of `make_environment`."""
        super().__init__(env)
        spaces = dict(env.observation_space.spaces)
        objects = spaces.pop("objects")
        own = {"agent_pos": spaces.pop("state")}
        own["environment_state"] = Box(objects.low.ravel(), objects.high.ravel(), dtype=np.float32)
        self._pictures = tuple(spaces)
        self.observation_space = Dict(own | ({"pixels": Dict(spaces)} if spaces else {}))

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, Any]:
        """Rename an observation."""
        seen: dict[str, Any] = {
            "agent_pos": observation["state"],
            "environment_state": observation["objects"].ravel(),
        }
        if self._pictures:
            seen["pixels"] = {name: observation[name] for name in self._pictures}
        return seen


def make_env(
    dataset: str, n_envs: int = 1, use_async_envs: bool = False, max_steps: int = 1000, **options: Any
) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make environments of a dataset's scenes and tasks for LeRobot; `options` are those of `make_environment`."""
    make = partial(_make_one, dataset, max_steps, options)
    kind = gymnasium.vector.AsyncVectorEnv if use_async_envs else gymnasium.vector.SyncVectorEnv
    return kind([make] * n_envs)


def _make_one(dataset: str, max_steps: int, options: dict[str, Any]) -> gymnasium.Env[dict[str, Any], np.ndarray]:
    env = make_environment(dataset, **options)
    return gymnasium.wrappers.TimeLimit(LeRobotObservation(env), max_steps)
