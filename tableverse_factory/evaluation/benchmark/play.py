"""One episode played by a policy: the environment, what the policy is told, and what came of it."""

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import numpy as np

from schemas.curation import Relation
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.delivery.learning.environment import FPS, TableEnv
from tableverse_factory.evaluation.benchmark.added_objects import add_objects
from tableverse_factory.evaluation.benchmark.benchmark import Benchmark, Episode, digest_scene
from tableverse_factory.evaluation.benchmark.observation import LazyObservation
from tableverse_factory.evaluation.benchmark.policy import (
    POINTS_PER_OBJECT,
    EpisodeStart,
    Policy,
    PolicyError,
    PolicyGoneError,
    check_action,
    is_privileged,
    sample_points,
)
from tableverse_factory.evaluation.benchmark.policy_failure import describe_failure
from tableverse_factory.evaluation.benchmark.results import EpisodeResult
from tableverse_factory.physics.mjcf.scene_objects import load_mesh

Told = TypeVar("Told")
Answer = TypeVar("Answer")
OUT_OF_TIME = "out_of_time"


def check_scene(benchmark: Benchmark, scene: Scene) -> Scene:
    """Check that a scene is the one that the benchmark was made of.

    Raises:
        InputError: `other_scenes` if its digest differs.
    """
    found, frozen = digest_scene(scene.files()), benchmark.scenes[scene.scene_id]
    if found != frozen:
        raise InputError(
            f"scene {scene.scene_id} is not the one of the benchmark (sha256 {found[:12]}, not {frozen[:12]}): "
            "give the dataset that it was made of, or build that again from its seed with the same version",
            "other_scenes",
        )
    return scene


def open_episode(benchmark: Benchmark, episode: Episode, dataset: Dataset) -> TableEnv:
    """Open the environment of an episode, without pictures."""
    scene = check_scene(benchmark, dataset.scene(episode.scene_id))
    added = [(check_scene(benchmark, dataset.scene(t.scene_id)), t) for t in episode.perturbation.added]
    return TableEnv(
        add_objects(scene, added),
        episode.task.model_dump(mode="json"),
        benchmark.robot,
        base=episode.base,
        max_steps=episode.limit_steps,
        max_disturbed_m=benchmark.max_disturbed_m,
        variation=episode.variation,
    )


def make_start(episode: Episode, env: TableEnv, *, privileged: bool) -> EpisodeStart:
    """Make what a policy is told of an episode; points are drawn from the seed of the episode."""
    rng = make_rng(episode.seed, episode.scene_id, "points of policies")
    files = env.scene.files()
    points = [sample_points(load_mesh(files, name), POINTS_PER_OBJECT, rng) for name in env.sim.object_ids]
    ends = np.ones(env.action_space.shape[0])
    return EpisodeStart(
        episode_id=episode.episode_id,
        seed=episode.seed,
        instruction=env.sim.instruction,
        relation=Relation(episode.task.relation),
        points=np.stack(points),
        robot=env.sim.station.arm.name,
        base=env.sim.station.base,
        lower=env.action_to_command(-ends),
        upper=env.action_to_command(ends),
        step_s=1.0 / FPS,
        limit_steps=episode.limit_steps,
        env=env if privileged else None,
    )


def play_episode(benchmark: Benchmark, episode: Episode, dataset: Dataset, policy: Policy) -> EpisodeResult:
    """Play an episode to its end; an error of the policy ends it, with its reason in the result."""
    env = open_episode(benchmark, episode, dataset)
    observation, info = env.reset(seed=episode.seed)
    reason, detail, steps = OUT_OF_TIME, "", 0
    try:
        start = make_start(episode, env, privileged=is_privileged(policy))
        _ask(policy.reset, start)
        done = False
        while not done:
            seen = LazyObservation(observation, policy.pictures, partial(_take, env, policy))
            action = check_action(_ask(policy.act, seen), len(start.lower))
            seen.expire()
            observation, _, ended, truncated, info = env.step(action)
            steps, done = steps + 1, ended or truncated
        reason = "" if info["success"] else info["failure"] or OUT_OF_TIME
    except PolicyError as error:
        reason, detail = error.reason, str(error)
    return make_result(episode, reason, detail, steps, info)


def _take(env: TableEnv, policy: Policy) -> dict[str, np.ndarray]:
    return env.take_pictures(policy.pictures, policy.picture_size)


def make_result(
    episode: Episode, reason: str, detail: str, steps: int = 0, info: Mapping[str, Any] | None = None
) -> EpisodeResult:
    """Make the row of an episode; `info` is the last of its environment, None if it was lost with its process."""
    info = info or {}
    return EpisodeResult(
        episode_id=episode.episode_id,
        scene_id=episode.scene_id,
        task_id=episode.task.task_id,
        split=episode.split,
        tier=episode.difficulty.tier,
        axis=episode.perturbation.axis,
        relation=episode.task.relation,
        success=not reason,
        reason=reason,
        detail=sanitize_line(detail, 300),
        steps=steps,
        lifted=bool(info.get("lifted", False)),
        disturbed_m=round(float(info.get("disturbed_m", 0.0)), 6),
    )


def _ask(question: Callable[[Told], Answer], told: Told) -> Answer:
    """Ask a policy; whatever it raises is its failure."""
    try:
        return question(told)
    except PolicyGoneError:
        raise
    except Exception as error:  # of foreign code, whose failure is a result
        if isinstance(error, PolicyError) and re.fullmatch("[a-z_]{1,60}", str(error.reason)):
            raise
        raise PolicyError("policy_error", describe_failure(error, 300)) from error
