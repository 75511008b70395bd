"""The export in the hands of those it is made for: the packages `lerobot` and `datasets`."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tableverse_factory import TableEnv, open_dataset
from tableverse_factory.delivery.episodes.lerobot import LeRobotOptions, export_lerobot
from tableverse_factory.delivery.episodes.pictures import take_recorded_pictures
from tableverse_factory.delivery.episodes.selection import open_episode, select_rows
from tableverse_factory.robotics.robots.registry import load_arm
from tests.helpers.learnable_dataset import write_learnable_dataset

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return write_learnable_dataset(tmp_path_factory.mktemp("real") / "out", scenes=2, moved=2)


@pytest.fixture(scope="module")
def made(out, tmp_path_factory):
    dest = tmp_path_factory.mktemp("exported") / "made"
    export_lerobot(open_dataset(out), dest, LeRobotOptions(failed=True, fps=25, width=64, height=48))
    return dest


def test_the_numbers_are_those_that_the_environment_shows(out, made):
    """Replayed command by command, the environment observes what stands in the frames."""
    import pyarrow.parquet as pq

    scene = open_dataset(out).scene("s-1")
    env = TableEnv(scene, "task_000")
    env.reset(seed=0)
    seen = []
    for command in scene.trajectory("task_000").recording().command[1:]:
        observation, _, terminated, *_ = env.step(env.command_to_action(command))
        seen.append(np.concatenate([observation["state"], observation["objects"].ravel()]))
        if terminated:
            break
    table = pq.read_table(made / "data")
    frames = table.filter(table["episode_index"].to_numpy() == 0).to_pydict()
    told = np.concatenate([frames["observation.state"], frames["observation.environment_state"]], axis=1)
    count = min(len(told) - 1, len(seen) // 2)
    away = np.abs(told[1 : count + 1] - np.array(seen)[1 : 2 * count : 2])
    assert count > 50
    assert np.delete(away, 14, axis=1).max() < 1e-5
    assert away[:, 14].max() < 3e-3, "the gripper opened elsewhere before the recording"


@pytest.mark.filterwarnings("ignore")
def test_lerobot_reads_frames_statistics_and_delta_timestamps(made):
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="LeRobot is not installed")
    deltas = {"observation.state": [-0.04, 0.0], "action": [0.0, 0.04, 0.08], "observation.images.front": [-0.04, 0.0]}
    dataset = lerobot.LeRobotDataset("tableverse", root=made, delta_timestamps=deltas, video_backend="pyav")
    info = json.loads((made / "meta/info.json").read_text())
    assert (
        (dataset.num_frames, dataset.num_episodes)
        == (info["total_frames"], info["total_episodes"])
        == (len(dataset), 4)
    )
    first, last = dataset[0], dataset[len(dataset) - 1]
    assert first["observation.images.front"].shape == (2, 3, 48, 64)
    assert first["observation.environment_state"].shape == (21,)
    assert first["observation.state_is_pad"].tolist() == [True, False]
    assert last["action_is_pad"].tolist() == [False, True, True]
    assert first["task"] == "Pick up the wooden block and place it next to the bowl"
    assert first["subtask"] == "pre-grasp"
    actions = np.stack([dataset[k]["action"][0].numpy() for k in range(len(dataset))])
    assert np.allclose(actions.mean(axis=0), dataset.meta.stats["action"]["mean"], atol=1e-5)
    assert np.allclose(actions.std(axis=0), dataset.meta.stats["action"]["std"], atol=1e-5)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("pictures", [True, False])
def test_act_takes_a_step_on_it(made, pictures):
    """With pictures, and on states alone, which ACT takes because objects are `observation.environment_state`."""
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="LeRobot is not installed")
    import torch
    from lerobot.configs.types import FeatureType
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    try:
        from lerobot.utils.feature_utils import dataset_to_policy_features
    except ImportError:
        from lerobot.datasets.utils import dataset_to_policy_features

    meta = lerobot.LeRobotDatasetMetadata("tableverse", root=made)
    features = dataset_to_policy_features(meta.features)
    seen = {name: each for name, each in features.items() if each.type is not FeatureType.ACTION}
    assert seen["observation.environment_state"].type is FeatureType.ENV
    seen = {name: each for name, each in seen.items() if pictures or each.type is not FeatureType.VISUAL}
    config = ACTConfig(
        input_features=seen, output_features={"action": features["action"]}, chunk_size=8, n_action_steps=8,
        dim_model=64, n_heads=2, dim_feedforward=64, n_encoder_layers=1, n_vae_encoder_layers=1, latent_dim=4,
        pretrained_backbone_weights=None, device="cpu", push_to_hub=False,
    )  # fmt: skip
    dataset = lerobot.LeRobotDataset(
        "tableverse", root=made, delta_timestamps={"action": [k / 25 for k in range(8)]}, video_backend="pyav"
    )
    policy = ACTPolicy(config)
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True)))
    optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
    losses = []
    for _ in range(8):
        loss, _ = policy.forward(dict(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss))
    assert losses[-1] < losses[0]


def test_lerobot_s_own_script_trains_act(made, tmp_path):
    """Run with lerobot 0.6.1, whose command it is, for a minute of one core."""
    pytest.importorskip("lerobot.scripts.lerobot_train", reason="LeRobot 0.6 is not installed")
    small = {"chunk_size": 8, "n_action_steps": 8, "dim_model": 64, "n_heads": 2, "dim_feedforward": 64}
    options = {
        "dataset.repo_id": "tableverse/made", "dataset.root": made, "dataset.video_backend": "pyav",
        "policy.type": "act",
        "policy.device": "cpu", "policy.push_to_hub": "false", "policy.pretrained_backbone_weights": "null",
        "policy.optimizer_lr": 1e-3, **{f"policy.{name}": value for name, value in small.items()},
        "batch_size": 4, "num_workers": 0, "steps": 20, "log_freq": 5, "save_freq": 20, "wandb.enable": "false",
        "output_dir": tmp_path / "runs",
    }  # fmt: skip
    arguments = [f"--{name}={value}" for name, value in options.items()]
    said = _run_script("lerobot_train", arguments, tmp_path)
    losses = [float(loss) for loss in re.findall(r" loss:([0-9.]+)", said)]
    assert len(losses) == 4
    assert losses[-1] < losses[0] / 2
    assert list(tmp_path.glob("runs/checkpoints/000020/pretrained_model/model.safetensors"))


def test_lerobot_s_visualiser_writes_an_episode(made, tmp_path):
    """Run with lerobot 0.6.1 and rerun-sdk 0.33.1."""
    pytest.importorskip("lerobot.scripts.lerobot_dataset_viz", reason="LeRobot 0.6 is not installed")
    pytest.importorskip("rerun", reason="Rerun is not installed")
    arguments = ["--repo-id=tableverse/made", f"--root={made}", "--episode-index=1", "--save=1", "--num-workers=0"]
    _run_script("lerobot_dataset_viz", [*arguments, f"--output-dir={tmp_path}"], tmp_path)
    (recording,) = tmp_path.glob("*.rrd")
    assert recording.stat().st_size > 50_000


def _run_script(name: str, arguments: list[str], home: Path) -> str:
    command = [sys.executable, "-m", f"lerobot.scripts.{name}", *arguments]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(home / "hub")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout + done.stderr


@pytest.mark.filterwarnings("ignore")
def test_lerobot_reads_depth_in_metres_and_instances_exactly(out, tmp_path):
    """From its version 0.6 on, which knows videos of depth."""
    pytest.importorskip("lerobot.datasets.depth_utils", reason="LeRobot 0.6 is not installed")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    pictures = ("front", "front_depth", "wrist_instances")
    dataset = open_dataset(out)
    export_lerobot(dataset, tmp_path / "made", LeRobotOptions(fps=5, width=64, height=48, pictures=pictures))
    episode = open_episode(dataset, select_rows(dataset, failed=False)[0])
    samples = list(range(0, len(episode.recording), 10))
    truth = take_recorded_pictures(pictures, episode, load_arm("panda"), (48, 64), samples)
    read = LeRobotDataset("tableverse", root=tmp_path / "made", video_backend="pyav", depth_output_unit="m")
    first = [e["scene_id"] for e in read.meta.episodes].index(episode.scene.scene_id)
    start = read.meta.episodes[first]["dataset_from_index"]
    for number in (0, 12, len(samples) - 1):
        item = read[start + number]
        depth = item["observation.images.front_depth"][0].numpy()
        assert np.abs(depth - truth["front_depth"][number][..., 0]).max() < 0.00051
        labels = np.rint(item["observation.images.wrist_instances"][0].numpy() * 255)
        assert np.array_equal(labels, truth["wrist_instances"][number][..., 0])


@pytest.mark.filterwarnings("ignore")
def test_datasets_finds_frames_and_episodes_by_the_card(made, tmp_path):
    datasets = pytest.importorskip("datasets", reason="the package datasets is not installed")
    frames = datasets.load_dataset(str(made), split="train", cache_dir=str(tmp_path))
    episodes = datasets.load_dataset(str(made), "episodes", split="train", cache_dir=str(tmp_path))
    assert frames.num_rows == json.loads((made / "meta/info.json").read_text())["total_frames"]
    assert frames[0]["subtask"] == "pre-grasp"
    assert len(frames[0]["observation.environment_state"]) == 21
    assert sorted(episodes["split"]) == ["train"] * 2 + ["validation"] * 2
    assert episodes[0]["paraphrases"][0] == "Put the wooden block next to the bowl"
