"""Training of the network of pictures: the same weights again, also in parts; files of other trainings are refused."""

import importlib.util
import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError, ModelError
from tableverse_factory.evaluation.training.picture.pool import MeshPool
from tests.evaluation.training.picture.conftest import SMALL

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from safetensors import safe_open  # noqa: E402
from safetensors.torch import load_file  # noqa: E402

from tableverse_factory.evaluation.training.checkpoint import CHECKPOINT, WEIGHTS, read_weights  # noqa: E402
from tableverse_factory.evaluation.training.picture import train as train_module  # noqa: E402
from tableverse_factory.evaluation.training.picture.network import make_network  # noqa: E402
from tableverse_factory.evaluation.training.picture.settings import PictureSettings  # noqa: E402
from tableverse_factory.evaluation.training.picture.train import TrainRun, compute_rate, train_pictures  # noqa: E402
from tableverse_factory.evaluation.training.picture.world import World  # noqa: E402

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("thin")]
SETTINGS = PictureSettings(3, **SMALL)


def train(folder: Path, pool: Path, settings: PictureSettings = SETTINGS, **run: object) -> list[str]:
    lines: list[str] = []
    folder.mkdir(exist_ok=True)
    options = {"device": "cpu", "validate": False} | run
    train_pictures(settings, TrainRun(folder, pool, **options), lines.append)
    return lines


def assert_same(one: Path, other: Path) -> None:
    first, second = (load_file(folder / CHECKPOINT) for folder in (one, other))
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


@pytest.mark.slow  # four trainings; tests/evaluation/training/policy resumes in the fast run
def test_stopped_after_any_step_and_resumed_gives_the_weights_of_one_go(pool_file: Path, tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", pool_file)
    assert sum(" samples/s" in line for line in whole) == 1
    for _ in range(3):  # no minutes: one step, and a checkpoint
        train(tmp_path / "parts", pool_file, minutes=0.0)
    assert_same(tmp_path / "whole", tmp_path / "parts")
    with safe_open(tmp_path / "whole" / CHECKPOINT, "pt") as file:
        assert json.loads(file.metadata()["positions"])[0]["made"] > SETTINGS.capacity, "some views were replaced"
    before = (tmp_path / "parts" / CHECKPOINT).stat().st_mtime_ns
    train(tmp_path / "parts", pool_file)
    assert (tmp_path / "parts" / CHECKPOINT).stat().st_mtime_ns == before, "nothing is left to do"


@pytest.mark.slow  # three trainings; the test above holds same weights, test_scenes.py same scenes
def test_processes_that_make_scenes_change_no_weight(pool_file: Path, tmp_path: Path) -> None:
    for jobs in (0, 1, 2):
        train(tmp_path / str(jobs), pool_file, jobs=jobs)
    assert_same(tmp_path / "0", tmp_path / "1")
    assert_same(tmp_path / "0", tmp_path / "2")
    train(tmp_path / "other", pool_file, replace(SETTINGS, seed=1))
    with pytest.raises(AssertionError):
        assert_same(tmp_path / "0", tmp_path / "other")


@pytest.mark.slow  # forty steps; tests/evaluation/training/policy learns in the fast run
def test_it_learns(pool_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_module, "LOG_STEPS", 1)
    settings = replace(SETTINGS, steps=40, batch=4, first=16, fresh=0.0)
    losses = []
    for line in train(tmp_path / "net", pool_file, settings):
        if " label " in line:
            words = line.partition(": ")[2].partition(";")[0].split()
            losses.append(sum(float(word) for word in words[1::2]))
    assert len(losses) == 40
    assert np.mean(losses[-6:]) < 0.8 * np.mean(losses[:6])


@pytest.mark.slow  # a training; that of policies refuses the same
def test_checkpoints_of_other_settings_or_another_network_or_of_nothing_are_refused(
    pool_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tmp_path, pool_file, replace(SETTINGS, steps=1))
    for change in ({"seed": 1}, {"batch": 3}, {"scenes": 3}, {"capacity": 65}):
        ((name, value),) = change.items()
        both = f"is of another training: {name} was {getattr(SETTINGS, name)} and is now {value}. Give the same, or"
        with pytest.raises(InputError, match=re.escape(both)):
            train(tmp_path, pool_file, replace(SETTINGS, **change))
    with monkeypatch.context() as older:
        older.setattr("tableverse_factory.evaluation.training.picture.network.ATTENTION", 2)
        with pytest.raises(InputError, match="of another network than this version trains"):
            train(tmp_path, pool_file)
        with pytest.raises(InputError, match="holds no weights of this network"):
            read_weights(tmp_path / WEIGHTS, make_network(0))
    for name, match in ((CHECKPOINT, "is not a checkpoint"), (WEIGHTS, "holds no weights")):
        data = (tmp_path / name).read_bytes()
        for damaged in (b"", b"\x80\x04 no safetensors", data[: len(data) // 2]):
            (tmp_path / name).write_bytes(damaged)
            with pytest.raises(InputError, match=match):
                train(tmp_path, pool_file) if name == CHECKPOINT else read_weights(tmp_path / WEIGHTS, make_network(0))


@pytest.mark.slow  # the test above refuses other settings by the same check
def test_a_checkpoint_is_continued_with_the_meshes_that_it_knows(
    pool: MeshPool, pool_file: Path, tmp_path: Path
) -> None:
    train(tmp_path, pool_file, minutes=0.0)
    others = tmp_path / "others.npz"
    replace(pool, size=pool.size * np.float32(1.01)).write(others)
    with pytest.raises(InputError, match=r"training: meshes was \S+ \(sha256 \w{12}\) and is now \S+others\.npz \(sha"):
        train(tmp_path, others)
    train(tmp_path, pool_file, minutes=0.0)


@pytest.mark.slow  # a training
def test_weights_are_the_averages_in_half_precision(pool_file: Path, tmp_path: Path) -> None:
    train(tmp_path, pool_file, replace(SETTINGS, steps=1))
    network, saved = make_network(0), load_file(tmp_path / CHECKPOINT)
    read_weights(tmp_path / WEIGHTS, network)
    for name, tensor in network.state_dict().items():
        assert torch.allclose(tensor.float(), saved[f"mean.{name}"].float(), rtol=1e-3, atol=1e-6), name
    assert (tmp_path / WEIGHTS).stat().st_size < 2.2 * sum(p.numel() for p in network.parameters())


@pytest.mark.slow  # two trainings
def test_a_training_starts_from_the_weights_of_another_and_continues_from_no_others(
    pool_file: Path, tmp_path: Path
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train(first, pool_file)
    settings = replace(SETTINGS, seed=1, rate=1e-9)
    train(second, pool_file, settings, start=first / WEIGHTS)
    old, new = (load_file(folder / WEIGHTS) for folder in (first, second))
    convolutions = [name for name in old if name.endswith("convolve.weight")]
    assert all(torch.allclose(old[name].float(), new[name].float(), atol=1e-5) for name in convolutions)
    with pytest.raises(InputError, match=r"training: --from was \S+ \(sha256 \w{12}\) and is now none"):
        train(second, pool_file, settings)
    with pytest.raises(InputError, match=r"training: --from was \S+ \(sha256 \w{12}\) and is now \S+ \(sha256 "):
        train(second, pool_file, settings, start=second / WEIGHTS)


@pytest.mark.slow  # forty views
def test_held_out_views_are_measured_at_a_checkpoint(
    pool_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_module, "VALIDATION_VIEWS", 40)
    lines = train(tmp_path, pool_file, replace(SETTINGS, steps=1), validate=True)
    figures = {}
    for line in lines[-2:]:
        name, _, said = line.partition(" step 1 ")[2].partition(": ")
        words = said.split()
        figures[name] = dict(zip(words[::2], map(float, words[1::2]), strict=True))
    assert figures.keys() == {"picture", "rgbd"}
    for each in figures.values():
        assert {*each} == {"depth", "scale", "covered", "normal_deg", "things", "votes_px", "table"}
        assert all(math.isfinite(value) for value in each.values())
        assert all(0 <= each[name] <= 1 for name in ("covered", "things", "table"))


@pytest.mark.slow  # a training
def test_a_loss_that_is_not_finite_ends_the_training_and_keeps_the_checkpoint(pool_file: Path, tmp_path: Path) -> None:
    wild = replace(SETTINGS, rate=1e30)
    train(tmp_path, pool_file, wild, minutes=0.0)
    kept = (tmp_path / CHECKPOINT).read_bytes()
    with pytest.raises(ModelError, match=r"loss of step 2 is not finite: .*; the last checkpoint is kept"):
        train(tmp_path, pool_file, wild)
    assert (tmp_path / CHECKPOINT).read_bytes() == kept
    for path in tmp_path.iterdir():
        path.unlink()
    with pytest.raises(ModelError, match=r"weights of step 2 are not finite; the last checkpoint is kept"):
        train(tmp_path, pool_file, wild, save_minutes=0.0)  # between two looks at the loss
    with safe_open(tmp_path / CHECKPOINT, "pt") as file:
        assert json.loads(file.metadata()["positions"])[0]["step"] == 1


def test_the_rate_rises_stays_and_falls() -> None:
    settings = replace(SETTINGS, steps=10_000)
    rates = [compute_rate(step, settings) / settings.rate for step in range(1, 10_001)]
    assert rates[0] < 0.01
    assert rates[399:6_000] == [1.0] * 5_601
    assert np.all(np.diff(rates[:399]) > 0)
    assert np.all(np.diff(rates[6_000:]) <= 0)
    assert 0 < rates[-1] < 0.03
    sizes = [PictureSettings(100).sample_size(step) for step in (1, 60, 61, 100)]
    assert sizes == [(320, 240), (320, 240), (384, 288), (384, 288)]


@pytest.mark.slow  # tests/evaluation/training/test_train.py runs the command
def test_the_command_trains_exports_and_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = {name: SMALL[name] for name in ("width", "height", "packages", "patterns", "flat", "fresh")}
    where = "tableverse_factory.evaluation.training.picture.settings.PictureSettings"
    monkeypatch.setattr(where, partial(PictureSettings, **small))
    monkeypatch.setattr(train_module, "VALIDATION_VIEWS", 8)
    options, folder = "--scenes 2 --batch 2 --views 64 --device cpu --jobs 0", tmp_path / "net"

    def run(more: str) -> Result:
        return CliRunner().invoke(app, ["train", "picture", str(folder), *options.split(), *more.split()])

    answers = [run("--steps 1"), run("--steps 2")]
    assert [answer.exit_code for answer in answers] == [0, 0], answers[0].output
    assert "picture.onnx: " in answers[0].stdout
    assert "1 of 1 steps" in answers[0].stdout
    assert "2 of 2 steps" in answers[1].stdout
    assert sorted(path.name for path in folder.iterdir()) == [
        CHECKPOINT,
        "meshes_2_0.npz",
        "picture.onnx",
        WEIGHTS,
    ]
    assert isinstance(run("--seed 1").exception, InputError)


@pytest.mark.skipif(importlib.util.find_spec("cupy") is not None, reason="cupy is installed")
def test_a_gpu_without_its_extra_is_told_in_one_line(world: World) -> None:
    with pytest.raises(InputError, match=r"needs cupy: pip install 'tableverse-factory\[training\]'") as told:
        world.make_renderer(SETTINGS, "cuda")
    assert "\n" not in str(told.value)
