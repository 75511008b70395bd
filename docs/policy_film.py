"""Draws the film of docs/policies.md, an episode of a benchmark as a policy plays it.

`python docs/policy_film.py BENCHMARK OUT EPISODE_ID FILE.webp`
"""

import sys
from pathlib import Path

from PIL import Image

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.evaluation.benchmark.benchmark import read_benchmark
from tableverse_factory.evaluation.benchmark.play import make_start, open_episode
from tableverse_factory.evaluation.training.policy.state_policy import StatePolicy

SIZE = (240, 320)
EVERY = 8  # steps of 1/50 s between two frames
LAST_MS = 1500


def main(benchmark_path: str, dataset: str, episode_id: str, dest: Path) -> None:
    """Play the episode with the policy of the package, and write every eighth step."""
    benchmark = read_benchmark(benchmark_path)
    episode = next(each for each in benchmark.episodes if each.episode_id == episode_id)
    env, policy = open_episode(benchmark, episode, open_dataset(dataset)), StatePolicy()
    observation, _ = env.reset(seed=episode.seed)
    policy.reset(make_start(episode, env, privileged=False))
    frames, ended, step = [], False, 0
    while not ended:
        if step % EVERY == 0:
            frames.append(Image.fromarray(env.take_pictures(("front",), SIZE)["front"]))
        observation, _, terminated, truncated, info = env.step(policy.act(observation))
        ended, step = terminated or truncated, step + 1
    frames.append(Image.fromarray(env.take_pictures(("front",), SIZE)["front"]))
    durations = [1000 * EVERY // 50] * (len(frames) - 1) + [LAST_MS]
    frames[0].save(dest, save_all=True, append_images=frames[1:], duration=durations, loop=0, quality=60, method=6)
    if not info["success"]:
        raise SystemExit(f"{episode_id}: {info['failure'] or 'out of time'}")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], Path(sys.argv[4]))
