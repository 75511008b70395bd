"""The export in the hands of those it is made for: the package `robomimic`, and the environment in `env_args`."""

import json

import gymnasium
import h5py
import numpy as np
import pytest

from tableverse_factory import open_dataset
from tableverse_factory.delivery.episodes.demonstration import name_picture
from tableverse_factory.delivery.episodes.robomimic import RobomimicOptions, export_robomimic
from tests.helpers.learnable_dataset import write_learnable_dataset

pytestmark = pytest.mark.slow

OPTIONS = RobomimicOptions(pictures=("front", "wrist", "front_depth", "front_instances"), width=64, height=48)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return write_learnable_dataset(tmp_path_factory.mktemp("real") / "out", scenes=2, moved=2)


@pytest.fixture(scope="module")
def made(out, tmp_path_factory):
    dest = tmp_path_factory.mktemp("exported") / "made.hdf5"
    export_robomimic(open_dataset(out), dest, OPTIONS)
    return dest


def test_the_environment_of_env_args_exists_and_the_actions_succeed_in_it(out, made):
    with h5py.File(made) as file:
        arguments = json.loads(file["data"].attrs["env_args"])
        for demo in file["data"].values():
            meta = json.loads(demo.attrs["ep_meta"])
            where = {"dataset": str(out), "scene": meta["scene_id"], "task": meta["task_id"]}
            env = gymnasium.make(arguments["env_name"], **where, **arguments["env_kwargs"])
            observation, info = env.reset(seed=0)
            assert info["instruction"] == meta["lang"]
            seen = demo["obs/object"][0].reshape(-1, 7)[:, [0, 1, 2, 6, 3, 4, 5]]
            assert np.allclose(observation["objects"], seen, atol=1e-6)
            actions = demo["actions"][()]
            for sample, action in enumerate([*actions, *[actions[-1]] * 100], 1):
                observation, _, terminated, _, info = env.step(action)
                if sample == 60:
                    for name in OPTIONS.pictures:
                        away = np.abs(observation[name].astype(float) - demo["obs"][name_picture(name)][60])
                        assert (away > 1e-4 + (name in ("front", "wrist"))).mean() < 0.002, name
                if terminated:
                    break
            assert info["success"]


@pytest.mark.filterwarnings("ignore")
def test_robomimic_trains_and_validates_on_it(made, tmp_path):
    """Two epochs of behaviour cloning by its own script, on states and pictures, with the masks `train` and `valid`."""
    pytest.importorskip("robomimic", reason="robomimic is not installed")
    import robomimic.utils.torch_utils
    from robomimic.config import config_factory
    from robomimic.scripts.train import train

    config = config_factory("bc")
    with config.values_unlocked():
        config.train.data, config.train.output_dir = str(made), str(tmp_path / "runs")
        config.train.hdf5_filter_key, config.train.hdf5_validation_filter_key = "train", "valid"
        config.train.num_epochs, config.train.batch_size, config.train.num_data_workers = 2, 16, 0
        config.experiment.save.enabled, config.experiment.save.every_n_epochs = True, 1
        config.experiment.validate, config.experiment.rollout.enabled = True, False
        config.experiment.epoch_every_n_steps = config.experiment.validation_epoch_every_n_steps = 10
        config.experiment.logging.log_tb = config.experiment.logging.terminal_output_to_txt = False
        config.observation.modalities.obs.low_dim = ["robot0_joint_pos", "robot0_gripper_qpos", "object"]
        config.observation.modalities.obs.rgb = ["agentview_image", "robot0_eye_in_hand_image"]
        config.observation.encoder.rgb.core_kwargs.pool_kwargs.num_kp = 4
        config.lock()
    train(config, robomimic.utils.torch_utils.get_torch_device(try_to_use_cuda=False))
    assert list(tmp_path.glob("runs/**/*.pth"))


@pytest.mark.filterwarnings("ignore")
def test_robomimic_tells_the_shapes_and_lengths(made):
    pytest.importorskip("robomimic", reason="robomimic is not installed")
    import robomimic.utils.file_utils as files
    import robomimic.utils.obs_utils as observations

    observations.initialize_obs_modality_mapping_from_dict({"low_dim": ["object", "robot0_joint_pos"]})
    shapes = files.get_shape_metadata_from_dataset(str(made), all_obs_keys=["object", "robot0_joint_pos"])
    assert (shapes["ac_dim"], shapes["all_shapes"]["object"]) == (8, [21])
    assert (
        files.get_env_metadata_from_dataset(str(made))["env_name"] == "tableverse_factory.gym:TableVerse/PickPlace-v0"
    )
    assert files.get_demos_for_filter_key(str(made), "valid") == ["demo_0"]
