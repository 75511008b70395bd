"""Baselines: the planner and a replayed motion reach what is known to be possible, chance does not."""

import shutil

import pyarrow.parquet as pq
import pytest

from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.evaluation.benchmark.load_policy import PolicyName, load_policy
from tableverse_factory.evaluation.benchmark.play import play_episode
from tableverse_factory.evaluation.benchmark.replay import ReplayPolicy

pytestmark = pytest.mark.heavy


def choose(benchmark, *names):
    return [episode for episode in benchmark.episodes if episode.episode_id in names]


@pytest.mark.slow  # plans and plays three times
def test_the_planner_succeeds_where_the_trajectory_did_also_from_a_moved_start_and_in_clutter(benchmark, dataset):
    planner = load_policy(PolicyName("planner"))
    for episode in choose(benchmark, "test_0000", "test_0000_start", "test_0000_clutter"):
        result = play_episode(benchmark, episode, dataset, planner)
        assert (result.success, result.reason, result.lifted) == (True, "", True)


def test_random_actions_fail_always_in_the_same_way(benchmark, dataset):
    policy = load_policy(PolicyName("random"))
    results = [play_episode(benchmark, episode, dataset, policy) for episode in choose(benchmark, "test_0000") * 2]
    assert results[0] == results[1]
    assert not results[0].success


def test_the_nearest_demonstration_of_training_is_replayed(benchmark, dataset):
    """The scenes differ in a bystander alone, and so the one training motion succeeds in all of them."""
    policy = ReplayPolicy(dataset.path)
    for episode in choose(benchmark, "train_0000", "test_0001"):
        assert play_episode(benchmark, episode, dataset, policy).success
    behind = choose(benchmark, "test_0001")[0]
    task = behind.task.model_copy(update={"relation": type(behind.task.relation)("behind")})
    result = play_episode(benchmark, behind.model_copy(update={"task": task}), dataset, policy)
    assert (result.reason, result.steps) == ("no_demonstration", 0)
    with pytest.raises(ConfigError, match="give its OUT as --weights"):
        ReplayPolicy()


def test_a_dataset_without_motions_is_refused_before_anything_is_played(dataset, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "out")
    for file in (tmp_path / "out" / "trajectories").glob("*.parquet"):
        pq.write_table(pq.read_table(file).slice(0, 0), file)
    with pytest.raises(InputError, match="no motion to replay"):
        ReplayPolicy(str(tmp_path / "out"))


@pytest.mark.parametrize("name", ["state", pytest.param("picture", marks=pytest.mark.slow)])
def test_policies_with_weights_of_the_package_reach_for_x(benchmark, dataset, name):
    pytest.importorskip("torch", reason="the extra `models` is not installed")
    result = play_episode(benchmark, benchmark.episodes[0], dataset, load_policy(PolicyName(name)))
    assert not result.reason.startswith("policy"), result.detail
    assert result.lifted
