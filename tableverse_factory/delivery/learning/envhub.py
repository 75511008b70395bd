"""Entry of LeRobot's EnvHub: environments of a dataset, with observations, actions and results as LeRobot expects.

An `env.py` in a repository of the Hub is three lines: docs/simulators.md#lerobots-envhub.
"""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.delivery.learning.dataset_environment import DatasetEnv, make_environment
from tableverse_factory.delivery.learning.environment import FPS, MAX_STEPS, TableEnv


class LeRobotEnv(gymnasium.Wrapper[dict[str, Any], np.ndarray, dict[str, np.ndarray], np.ndarray]):  # type: ignore[misc]
    """An environment in which policies that learned from a LeRobot export act.

    Observations are `agent_pos`, `environment_state` (all objects, flat) and `pixels`, which LeRobot makes
    `observation.state`, `observation.environment_state` and `observation.images.NAME`, as in an export. An action of
    shape (j + 1,) is a command: joints [rad] and the gripper's opening [m], reached after 1/`fps` s on a straight line
    from the last. `info["is_success"]` is LeRobot's word for success, `task_description` and `task` the instruction.
    """

    def __init__(self, env: DatasetEnv | TableEnv, fps: int = FPS) -> None:
        """Wrap an environment of `make_environment`; `fps` is that of the export, a divisor of 50."""
        super().__init__(env)
        if fps < 1 or FPS % fps:
            possible = ", ".join(str(its) for its in range(1, FPS + 1) if FPS % its == 0)
            raise ConfigError(f"{fps} frames per second, of {FPS} steps: give one of {possible}")
        self._table = env.current if isinstance(env, DatasetEnv) else env  # for the arm's limits, the same in all
        ends = np.ones(env.action_space.shape)
        low, high = (self._table.action_to_command(its).astype(np.float32) for its in (-ends, ends))
        self.action_space = Box(low, high, dtype=np.float32)
        spaces = dict(env.observation_space.spaces)
        objects = spaces.pop("objects")
        own = {"agent_pos": spaces.pop("state")}
        own["environment_state"] = Box(objects.low.ravel(), objects.high.ravel(), dtype=np.float32)
        self._pictures = tuple(spaces)
        self.observation_space = Dict(own | ({"pixels": Dict(spaces)} if spaces else {}))
        self.metadata = {**env.metadata, "render_fps": fps}
        self._steps = FPS // fps
        self._command = low
        self.task_description = self.task = ""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset the environment; options of LeRobot's own, `lerobot_…`, are left out."""
        kept = {name: value for name, value in (options or {}).items() if not name.startswith("lerobot_")}
        seen, info = self.env.reset(seed=seed, options=kept)
        joints = len(self._command) - 1
        self._command = np.append(seen["state"][:joints], seen["state"][2 * joints])
        self.task_description = self.task = info["instruction"]
        return self._rename(seen), info

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute one command; rewards of the steps of 1/50 s on the way to it add up."""
        if np.shape(action) != self._command.shape:
            raise InputError(f"action of shape {np.shape(action)}: give {self._command.shape}", "bad_action")
        start, rewards = self._command, 0.0
        for share in np.arange(1, self._steps + 1) / self._steps:
            command = start + share * (np.asarray(action) - start)
            seen, reward, ended, truncated, info = self.env.step(self._table.command_to_action(command))
            rewards += reward
            if ended or truncated:
                break
        self._command = np.asarray(action)
        return self._rename(seen), rewards, ended, truncated, {**info, "is_success": info["success"]}

    def _rename(self, seen: dict[str, np.ndarray]) -> dict[str, Any]:
        renamed: dict[str, Any] = {"agent_pos": seen["state"], "environment_state": seen["objects"].ravel()}
        return renamed | ({"pixels": {name: seen[name] for name in self._pictures}} if self._pictures else {})


def make_env(
    dataset: str,
    n_envs: int = 1,
    use_async_envs: bool = False,
    fps: int = FPS,
    max_steps: int | None = None,
    **options: Any,
) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make environments of a dataset's scenes and tasks for LeRobot.

    Args:
        dataset: As in `open_dataset`.
        n_envs: How many.
        use_async_envs: Step each in a process of its own.
        fps: Actions per second, as in the export that the policy learned from.
        max_steps: Actions after which an episode is truncated; None: those of 20 s.
        options: Those of `make_environment`.
    """
    steps = MAX_STEPS * fps // FPS if max_steps is None else max_steps
    make = partial(_make_one, dataset, fps, steps, options)
    kind = gymnasium.vector.AsyncVectorEnv if use_async_envs else gymnasium.vector.SyncVectorEnv
    return kind([make] * n_envs)


def _make_one(
    dataset: str, fps: int, max_steps: int, options: dict[str, Any]
) -> gymnasium.Env[dict[str, Any], np.ndarray]:
    return gymnasium.wrappers.TimeLimit(LeRobotEnv(make_environment(dataset, **options), fps), max_steps)
