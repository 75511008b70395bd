"""LeRobot's EnvHub: observations by its names, in as many environments as it asks for."""

import numpy as np
import pytest

from tableverse_factory import open_dataset
from tableverse_factory.delivery.episodes.observation import count_object_rows
from tableverse_factory.delivery.learning.envhub import make_env


@pytest.mark.heavy
def test_environments_have_observations_by_lerobot_s_names(out):
    envs = make_env(str(out), n_envs=2)
    seen, _ = envs.reset(seed=1)
    rows = count_object_rows(open_dataset(str(out)))
    assert seen["environment_state"].shape == (2, 7 * rows)
    assert seen["agent_pos"].shape[0] == 2
    assert envs.observation_space.contains(seen)
    after, reward, *_ = envs.step(np.zeros(envs.action_space.shape, dtype=np.float32))
    assert set(after) == {"agent_pos", "environment_state"}
    assert reward.shape == (2,)
    envs.close()


@pytest.mark.heavy
def test_pictures_are_pixels(out):
    envs = make_env(str(out), pictures=("front",), picture_size=(48, 64))
    seen, _ = envs.reset(seed=1)
    assert seen["pixels"]["front"].shape == (1, 48, 64, 3)
    envs.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_lerobot_takes_them(out):
    """Needs lerobot 0.6 and Python 3.12."""
    utils = pytest.importorskip("lerobot.envs.utils", reason="installed where it is tested")
    envs = make_env(str(out), n_envs=2)
    seen = utils.preprocess_observation(envs.reset(seed=1)[0])
    assert set(seen) == {"observation.state", "observation.environment_state"}
    envs.close()
