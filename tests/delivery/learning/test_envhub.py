"""LeRobot's EnvHub: what its policies see and command, in as many environments as it asks for."""

from itertools import chain, repeat

import gymnasium
import numpy as np
import pytest

from tableverse_factory import open_dataset
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.delivery.episodes.observation import count_object_rows
from tableverse_factory.delivery.learning.envhub import make_env
from tests.helpers.docs_pages import find_example

INSTRUCTION = "Pick up the wooden block and place it next to the bowl"


@pytest.mark.heavy
def test_environments_have_observations_by_lerobot_s_names(out):
    envs = make_env(str(out), n_envs=2)
    seen, _ = envs.reset(seed=1, options={"lerobot_new_rollout": True})
    rows = count_object_rows(open_dataset(str(out)))
    assert seen["environment_state"].shape == (2, 7 * rows)
    assert seen["agent_pos"].shape[0] == 2
    assert envs.observation_space.contains(seen)
    assert envs.call("task_description") == (INSTRUCTION, INSTRUCTION)
    after, reward, *_, info = envs.step(envs.action_space.sample())
    assert set(after) == {"agent_pos", "environment_state"}
    assert reward.shape == (2,)
    assert info["is_success"].tolist() == [False, False]
    envs.close()


@pytest.mark.heavy
def test_pictures_are_pixels(out):
    envs = make_env(str(out), pictures=("front",), picture_size=(48, 64))
    seen, _ = envs.reset(seed=1)
    assert seen["pixels"]["front"].shape == (1, 48, 64, 3)
    envs.close()


@pytest.mark.heavy
@pytest.mark.parametrize("fps", [50, 10])
def test_the_actions_of_an_export_succeed(out, fps):
    recording = open_dataset(str(out)).scene("s-0").trajectory("task_000").recording()
    envs = make_env(str(out), fps=fps, scene="s-0", task="task_000")
    assert envs.call("_max_episode_steps") == (20 * fps,)
    envs.reset(seed=0)
    every = round(1.0 / (fps * recording.step_s))
    for command in chain(recording.command[every::every], repeat(recording.command[-1], 2 * fps)):
        _, _, ended, _, info = envs.step(command[None].astype(np.float32))
        if ended[0]:
            break
    assert info["is_success"].tolist() == [True]
    envs.close()


@pytest.mark.heavy
def test_an_action_without_all_joints_is_refused(out):
    (env,) = make_env(str(out)).envs
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"action of shape \(1,\): give \(8,\)"):
        env.step(np.zeros(1, dtype=np.float32))


@pytest.mark.heavy
def test_a_rate_that_steps_do_not_divide_into_is_refused(out):
    with pytest.raises(ConfigError, match="20 frames per second, of 50 steps: give one of 1, 2, 5, 10, 25, 50"):
        make_env(str(out), fps=20)


@pytest.fixture
def hub_cache(out, tmp_path, monkeypatch):
    """The cache of a Hub that cannot be reached, with the page's `env.py` for the dataset of these tests."""
    pytest.importorskip("lerobot", reason="installed where it is tested")
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    code = find_example("simulators.md", "envhub.make_env").text
    code = code.replace("hf://datasets/OWNER/NAME", str(out)).replace('split="test"', 'scene="s-0", task="task_000"')
    repository, revision = tmp_path / "models--OWNER--NAME", "0" * 40
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text(revision)
    (repository / "snapshots" / revision).mkdir(parents=True)
    (repository / "snapshots" / revision / "env.py").write_text(code)
    return tmp_path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_lerobot_loads_the_documented_file_and_evaluates_policies(out, hub_cache):
    """Run with lerobot 0.6.1 and Python 3.12: a motion's commands succeed, an untrained ACT policy does not."""
    import torch
    from lerobot.envs.factory import make_env
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.scripts.lerobot_eval import eval_policy, rollout

    recording = open_dataset(str(out)).scene("s-0").trajectory("task_000").recording()
    commands, every = recording.command, round(1.0 / (50 * recording.step_s))  # the page's rate is the default

    class Replay(torch.nn.Module):
        def reset(self) -> None:
            self.commands = chain(commands[every::every], repeat(commands[-1]))

        def select_action(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
            assert seen["task"] == [INSTRUCTION]
            return torch.from_numpy(next(self.commands)[None].astype(np.float32))

    suites = make_env("OWNER/NAME", hub_cache_dir=str(hub_cache), trust_remote_code=True)
    assert {name: list(tasks) for name, tasks in suites.items()} == {"hub_env": [0]}
    envs, same = suites["hub_env"][0], PolicyProcessorPipeline(steps=[])
    assert rollout(envs, Replay(), same, same, same, lambda action: action, seeds=[0])["success"].any()

    policy, before, after = make_untrained_act(envs)
    short = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.wrappers.TimeLimit(envs.envs[0].env, 3)])
    result = eval_policy(short, policy, same, same, before, after, n_episodes=2, start_seed=0)
    assert [episode["success"] for episode in result["per_episode"]] == [False, False]


def make_untrained_act(envs):
    """A small ACT policy on all observations of the environments, with its processors."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    space = envs.single_observation_space
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, space["agent_pos"].shape),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, space["environment_state"].shape),
    }
    for name, picture in space["pixels"].items():
        inputs[f"observation.images.{name}"] = PolicyFeature(FeatureType.VISUAL, (3, *picture.shape[:2]))
    config = ACTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, envs.single_action_space.shape)},
        device="cpu",
        pretrained_backbone_weights=None,
        dim_model=32,
        dim_feedforward=32,
        n_heads=2,
    )
    return ACTPolicy(config), *make_act_pre_post_processors(config)
