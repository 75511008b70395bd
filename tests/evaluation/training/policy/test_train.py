"""Training of the policy on states: the same weights again, also in parts; other files are refused."""

import hashlib
import itertools
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.evaluation.training.policy.demonstrations import Demonstrations

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from safetensors.torch import load_file, save_file  # noqa: E402

from tableverse_factory.evaluation.training.checkpoint import CHECKPOINT, WEIGHTS  # noqa: E402
from tableverse_factory.evaluation.training.policy import network, validate  # noqa: E402
from tableverse_factory.evaluation.training.policy import train as training  # noqa: E402
from tableverse_factory.evaluation.training.policy.settings import PolicySettings  # noqa: E402
from tableverse_factory.evaluation.training.policy.state_policy import StatePolicy  # noqa: E402
from tableverse_factory.evaluation.training.policy.train import TrainRun, train_state_policy  # noqa: E402

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("thin")]
SETTINGS = PolicySettings(3, goals=2, flows=2, chunks=8)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validate, "GOALS", 4)
    monkeypatch.setattr(validate, "CHUNKS", 8)


def train(folder: Path, packed: Path, settings: PolicySettings = SETTINGS, **run: object) -> list[str]:
    lines: list[str] = []
    train_state_policy(settings, TrainRun(folder, packed, "cpu", **run), lines.append)  # type: ignore[arg-type]
    return lines


def assert_same(one: Path, other: Path) -> None:
    for name in (CHECKPOINT, WEIGHTS):
        first, second = load_file(one / name), load_file(other / name)
        assert first.keys() == second.keys()
        for key, tensor in first.items():
            assert torch.equal(tensor, second[key]), key


def test_stopped_after_any_step_and_resumed_gives_the_weights_of_one_go(packed: Path, tmp_path: Path) -> None:
    train(tmp_path / "whole", packed)
    for _ in range(3):  # no minutes: one step, and a checkpoint
        train(tmp_path / "parts", packed, minutes=0.0)
    assert_same(tmp_path / "whole", tmp_path / "parts")
    train(tmp_path / "other", packed, replace(SETTINGS, seed=1))
    with pytest.raises(AssertionError):
        assert_same(tmp_path / "whole", tmp_path / "other")


def test_weights_that_are_hardly_trained_are_said_to_be_with_the_time_of_all_steps(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = itertools.count(0.0, 30.0)
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: next(now)))  # every look takes 30 s
    lines = train(tmp_path / "few", packed, replace(SETTINGS, steps=3_000), minutes=0.0)
    (warning,) = [line for line in lines if "warning" in line]
    pace, hours = re.search(r"1 of 3000 steps, so the .* at (\S+) s/step all steps take (\S+) h", warning).groups()
    assert float(pace) >= 30.0
    assert float(hours) == pytest.approx(3_000 * float(pace) / 3_600, rel=0.05)
    assert "steps/s" not in "".join(lines)
    assert not any("warning" in line for line in train(tmp_path / "all", packed))


def _differing(name: str, old: Path, new: Path) -> str:
    was, now = (f"{path} (sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:12]})" for path in (old, new))
    return re.escape(f"is of another training: {name} was {was} and is now {now}. Give the same, or another folder")


def test_a_checkpoint_is_continued_with_its_own_settings_and_demonstrations(packed: Path, tmp_path: Path) -> None:
    train(tmp_path, packed, minutes=0.0)
    with pytest.raises(InputError, match=r"is of another training: chunks was \d+ and is now 9\. Give the same, or"):
        train(tmp_path, packed, replace(SETTINGS, chunks=9))
    own, others = Demonstrations.read(packed), tmp_path / "others.npz"
    replace(own, poses=own.poses + np.float32(0.01)).write(others)
    with pytest.raises(InputError, match=_differing("demonstrations", packed, others)):
        train(tmp_path, others)
    replace(own, held_out=own.held_out + np.uint8(1)).write(others)
    with pytest.raises(InputError, match=r"others\.npz holds no demonstrations to train on"):
        train(tmp_path / "new", others)


def test_weights_of_any_other_origin_are_refused(packed: Path, tmp_path: Path) -> None:
    train(tmp_path, packed, replace(SETTINGS, steps=1))
    path = tmp_path / WEIGHTS
    StatePolicy(path)
    good, weights = path.read_bytes(), load_file(path)
    name = next(iter(weights))
    for tensors in (
        {**weights, name: weights[name] * float("nan")},
        {**weights, name: weights[name][:1]},
        {**weights, "more": weights[name] + 1},
        {},
    ):
        save_file(tensors, path)
        with pytest.raises(InputError, match="holds no weights of this network"):
            StatePolicy(path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    with pytest.raises(InputError, match=rf"{path} \(sha256 {digest}\) holds no weights .* Missing key\(s\)"):
        StatePolicy(path)
    torch.save(weights, path)  # a pickle
    with pytest.raises(InputError, match="holds no weights of this network"):
        StatePolicy(path)
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match="holds no weights of this network"):
        StatePolicy(path)


def test_it_learns(packed: Path, tmp_path: Path) -> None:
    lines = train(tmp_path, packed, replace(SETTINGS, steps=60, chunks=32, rate=2e-3), log_steps=1)
    parts = [line.partition(": ")[2].partition(";")[0].split() for line in lines if " flow " in line]
    losses = [sum(float(word) for word in words[1::2]) for words in parts]
    assert len(losses) == 60
    assert np.mean(losses[-6:]) < 0.6 * np.mean(losses[:6])


@pytest.mark.slow
def test_overfitted_to_one_demonstration_it_draws_its_goals_and_makes_its_motion(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"WIDTH": 64, "MOTION": 2}.items():
        monkeypatch.setattr(network, name, value)
    monkeypatch.setattr(validate, "GOALS", 32)
    monkeypatch.setattr(validate, "CHUNKS", 128)
    settings = replace(SETTINGS, steps=700, goals=8, flows=8, chunks=64, rate=2e-3)
    last = train(tmp_path, packed, settings)[-1].partition("trained on: ")[2].split()
    found = dict(zip(last[::2], map(float, last[1::2]), strict=True))
    assert found["grasp_mm"] < 8.0, found
    assert found["release_mm"] < 12.0, found
    assert max(found["grasp_deg"], found["release_deg"]) < 8.0, found
    assert found["position"] < 0.25, "some millimetres near the goals, some centimetres far away"
    assert found["phase"] < 0.1, found


def test_the_command_packs_trains_and_continues(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = "tableverse_factory.evaluation.training.policy"
    monkeypatch.setattr(f"{where}.settings.PolicySettings", partial(PolicySettings, flows=2))
    monkeypatch.setattr("tableverse_factory.dataset.splits.SPLITS", {"train": 1.0})  # whatever its hash
    folder = tmp_path / "net"

    def run(*more: str) -> str:
        options = ["--goals", "2", "--chunks", "4", "--device", "cpu", *more]
        answer = CliRunner().invoke(app, ["train", "policy", str(folder), *options])
        return f"{answer.output} {answer.exception}"

    assert "give --dataset, whose motions are packed into it" in run("--steps", "1")
    assert "1 of 1 steps" in run("--steps", "1", "--dataset", str(dataset.path))
    assert "2 of 2 steps" in run("--steps", "2")
    assert "--dataset is not read" in run("--steps", "2", "--dataset", "another")
    assert sorted(path.name for path in folder.iterdir()) == [CHECKPOINT, "demonstrations.npz", WEIGHTS]


def test_training_needs_neither_a_simulator_nor_a_dataset() -> None:
    """Where networks are trained, numpy and torch are there, and little else."""
    code = (
        "import sys\nimport tableverse_factory.evaluation.training.policy.train\n"
        "absent = {'mujoco', 'open3d', 'ray', 'pyarrow', 'trimesh', 'scipy', 'pydantic', 'gymnasium', 'PIL'}\n"
        "print(sorted(absent & {name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
