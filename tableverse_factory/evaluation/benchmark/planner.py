"""Baseline `planner`: the factory's own planner, from the true state at the start, played without feedback."""

from collections.abc import Mapping

import numpy as np

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.cache_dir import get_cache_dir
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.benchmark.added_objects import move_objects
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart, PolicyError
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.rollout import build_commands
from tableverse_factory.stages.trajectories.search import search_motion
from tableverse_factory.stages.trajectories.work_cell import WorkCell


class PlannerPolicy:
    """Policy that plans at the start, tries its motions in simulation, and plays the first that succeeds there.

    It is told the true meshes, poses and masses, but neither other friction nor anything that happens later.
    """

    pictures: tuple[str, ...] = ()
    picture_size = (96, 128)
    privileged = True

    def reset(self, start: EpisodeStart) -> None:
        """Plan the episode; PolicyError `no_plan` if no motion succeeds."""
        if start.env is None:
            raise PolicyError("no_plan", "the planner needs the environment itself")
        sim = start.env.sim
        now = dict(zip(sim.object_ids, sim.poses(), strict=True))
        scene = move_objects(start.env.scene, now)
        for_things, for_task = make_rng(start.seed, start.episode_id, "planner").spawn(2)
        config = TrajectoriesConfig(robot=start.robot, step_s=start.step_s, max_disturbed_m=sim.goal.max_disturbed_m)
        cell = WorkCell(
            scene.files(),
            scene.object_rows(),
            sim.station.arm,
            config,
            for_things,
            Services(get_cache_dir()),
            start.base,
        )
        found = search_motion(cell, sim.goal, for_task)
        if found.attempt is None or not found.attempt.success or found.attempt.motion is None:
            raise PolicyError("no_plan", f"{found.reason or 'no motion succeeds'}: {found.detail}")
        self._actions = [start.to_action(command) for command in build_commands(found.attempt.motion).targets]
        self._step = 0

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:  # noqa: ARG002 it is played blindly
        """Play the next command, and the last one until the end."""
        action = self._actions[min(self._step, len(self._actions) - 1)]
        self._step += 1
        return action
