"""The environment of a whole dataset, as Gymnasium makes it from names, and splits by picture."""

import os
import subprocess
import sys
from collections import Counter

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tableverse_factory import DatasetEnv
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.dataset.splits import SPLITS, find_split
from tests.helpers.learnable_dataset import write_learnable_dataset

pytestmark = pytest.mark.heavy

ID = "tableverse_factory.gym:TableVerse/PickPlace-v0"
PICTURES = {"pictures": ("front", "wrist"), "picture_size": (48, 64)}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """Three scenes, two of which have a task that is solved."""
    return write_learnable_dataset(tmp_path_factory.mktemp("drawn") / "out", scenes=3, moved=2)


def test_scenes_of_one_picture_share_a_split_and_the_shares_are_kept():
    counts = Counter(find_split(f"picture {k}") for k in range(5000))
    for name, share in SPLITS.items():
        assert counts[name] / 5000 == pytest.approx(share, abs=0.015)
    assert len({find_split(f"{name}-0123456789ab") for name in ("cup", "mug-2", "0")}) == 1


@pytest.mark.slow  # test_environment.py asks a checker
def test_both_checkers_of_gymnasium_are_content(out):
    env = gymnasium.make(ID, dataset=str(out), **PICTURES, render_mode="rgb_array", render_size=(48, 64))
    check_env(env.unwrapped)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert info["instruction"] == "Pick up the wooden block and place it next to the bowl"


def test_every_solved_task_of_a_split_is_drawn_and_no_other(out):
    env = DatasetEnv(str(out))
    assert env.tasks == (("s-0", "task_000"), ("s-1", "task_000"))
    drawn = [(info["scene_id"], info["task_id"]) for info in (env.reset(seed=k)[1] for k in range(12))]
    assert set(drawn) == set(env.tasks)
    assert drawn == [(i["scene_id"], i["task_id"]) for i in (env.reset(seed=k)[1] for k in range(12))]
    assert (find_split("s-0"), find_split("s-1")) == ("validation", "train"), "their ids, as they are of no picture"
    assert DatasetEnv(str(out), "validation").tasks == (("s-0", "task_000"),)
    assert DatasetEnv(str(out), "train").tasks == (("s-1", "task_000"),)
    with pytest.raises(InputError, match="no motion of panda solves a task of the 0 scenes of"):
        DatasetEnv(str(out), "test")


def test_a_chosen_task_is_the_environment_of_that_scene(out):
    env = DatasetEnv(str(out), max_steps=2)
    for task in env.tasks:
        observation, info = env.reset(seed=3, options={"task": task})
        assert (info["scene_id"], info["task_id"]) == task
        alone = gymnasium.make(ID, dataset=str(out), scene=task[0], task=task[1])
        assert np.array_equal(observation["objects"], alone.reset(seed=0)[0]["objects"])
        assert [env.step(np.zeros(8))[3] for _ in range(2)] == [False, True]
    with pytest.raises(ConfigError, match=r"task \('s-9', 'task_000'\): give one of `tasks`"):
        env.reset(options={"task": ("s-9", "task_000")})


def test_what_is_no_environment_of_a_dataset_is_said(out):
    with pytest.raises(ConfigError, match="split 'valid': give one of train, validation, test"):
        gymnasium.make(ID, dataset=str(out), split="valid")
    with pytest.raises(ConfigError, match="give scene and task, or a split alone"):
        gymnasium.make(ID, dataset=str(out), scene="s-0")
    with pytest.raises(ConfigError, match="give scene and task, or a split alone"):
        gymnasium.make(ID, dataset=str(out), scene="s-0", task="task_000", split="train")


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vectorised_by_its_name(out, mode):
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, dataset=str(out), max_objects=5)
    observation, info = envs.reset(seed=7)
    assert {name: array.shape for name, array in observation.items()} == {"state": (2, 22), "objects": (2, 5, 7)}
    observation, rewards, *_ = envs.step(envs.action_space.sample())
    envs.close()
    assert rewards.shape == (2,)
    assert set(info["scene_id"]) <= {"s-0", "s-1"}


@pytest.mark.slow  # test_environment.py starts such a process
def test_the_name_is_enough_for_a_process_that_imports_gymnasium_alone(out):
    code = "import sys, gymnasium; print(gymnasium.make(sys.argv[1], dataset=sys.argv[2]).reset(seed=0)[1]['task_id'])"
    done = subprocess.run([sys.executable, "-c", code, ID, str(out)], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "task_000", done.stderr[-2000:]


def test_a_window_is_opened_by_gymnasium(out):
    """`HumanRendering` shows our pictures; alone, the environment says so."""
    with pytest.raises(ConfigError, match=r"'human' needs gymnasium\.make, which opens a window"):
        DatasetEnv(str(out), render_mode="human")
    with pytest.warns(UserWarning, match="HumanRendering wrapper is being applied"):
        env = gymnasium.make(ID, dataset=str(out), render_mode="human", render_size=(48, 64))
    assert isinstance(env, gymnasium.wrappers.HumanRendering)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_window_shows_what_happens(out, monkeypatch):
    pytest.importorskip("pygame", reason="Gymnasium's window needs pygame")
    monkeypatch.setitem(os.environ, "SDL_VIDEODRIVER", "dummy")
    with pytest.warns(UserWarning, match="HumanRendering"):
        env = gymnasium.make(ID, dataset=str(out), render_mode="human", render_size=(48, 64))
    env.reset(seed=0)
    env.step(np.zeros(8, np.float32))
    env.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Your observation objects has an unconventional shape")
def test_stable_baselines3_is_content_and_learns(out):
    """Its checker, and a hundred steps of PPO on two environments."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="Stable-Baselines3 is not installed")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    for names in ({}, {"scene": "s-0", "task": "task_000", "reward": "dense"}):
        checker.check_env(gymnasium.make(ID, dataset=str(out), **PICTURES, **names))
    envs = make_vec_env(ID, n_envs=2, env_kwargs={"dataset": str(out)})
    model = PPO("MultiInputPolicy", envs, n_steps=32, batch_size=32, n_epochs=1, device="cpu").learn(64)
    assert model.num_timesteps == 64
