"""Several processes of a training: means, agreement, the same weights in parts, and an end when one of them ends."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from tableverse_factory.core.errors import InputError, ModelError
from tests.evaluation.training.picture.conftest import SMALL

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from safetensors import safe_open  # noqa: E402
from safetensors.torch import load_file  # noqa: E402

from tableverse_factory.evaluation.training.checkpoint import CHECKPOINT  # noqa: E402
from tableverse_factory.evaluation.training.picture import network  # noqa: E402
from tableverse_factory.evaluation.training.picture import train as train_module  # noqa: E402
from tableverse_factory.evaluation.training.picture.ranks import Ranks, start_ranks  # noqa: E402
from tableverse_factory.evaluation.training.picture.settings import PictureSettings  # noqa: E402
from tableverse_factory.evaluation.training.picture.train import TrainRun, train_pictures  # noqa: E402

pytestmark = pytest.mark.heavy


def take_part(folder: Path, ranks: Ranks) -> None:
    """Average, agree and gather, and write down what came out."""
    tensors = [torch.full((2, 3), float(ranks.rank)), torch.tensor([10.0 * ranks.rank])]
    ranks.average(tensors)
    flags = ranks.agree(ranks.rank == 0, ranks.rank == 1)
    seen = [each.tolist() for each in tensors], flags, ranks.gather(ranks.rank), ranks.shift_seed(5)
    (folder / f"{ranks.rank}.json").write_text(json.dumps(seen))


def end_at_once(_: Path, ranks: Ranks) -> None:
    """End without a word, as a process that is killed."""
    os._exit(7 if ranks.rank else 0)


@pytest.mark.slow  # several processes that import torch
def test_processes_average_follow_the_first_one_and_gather(tmp_path: Path) -> None:
    with start_ranks(2, "cpu", take_part, tmp_path) as ranks:
        take_part(tmp_path, ranks)
    first, second = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in (0, 1))
    assert first[:3] == second[:3] == [[[[0.5] * 3] * 2, [5.0]], [True, False], [0, 1]]
    assert first[3] == 5 != second[3]


def test_a_process_that_ends_ends_the_training(tmp_path: Path) -> None:
    with start_ranks(2, "cpu", end_at_once, tmp_path) as ranks:
        ranks.others[0].join(60)
        with pytest.raises(ModelError, match="process 1 of the training ended with 7"):
            ranks.agree(True)


def train_thin(settings: PictureSettings, run: TrainRun, ranks: Ranks) -> int:
    """Train a network of few channels; a process that is started knows nothing of the fixture `thin`."""
    network.WIDTHS, network.ATTENTION = (8, 16, 24, 32), 1
    return train_module._train_rank(settings, run, ranks)


@pytest.mark.slow  # four trainings in two processes each
@pytest.mark.usefixtures("thin")
def test_two_processes_in_parts_give_the_weights_of_one_go(pool_file: Path, tmp_path: Path) -> None:
    settings = PictureSettings(2, **SMALL | {"fresh": 40.0}, gpus=2)

    def train(folder: Path, minutes: float = 60.0) -> dict[str, "torch.Tensor"]:
        folder.mkdir(exist_ok=True)
        run = TrainRun(folder, pool_file, "cpu", minutes=minutes, validate=False)
        with start_ranks(2, "cpu", train_thin, settings, run) as ranks:
            train_thin(settings, run, ranks)
        return load_file(folder / CHECKPOINT)

    whole = train(tmp_path / "whole")
    for _ in range(2):
        parts = train(tmp_path / "parts", minutes=0.0)
    assert all(torch.equal(tensor, parts[name]) for name, tensor in whole.items())
    with safe_open(tmp_path / "whole" / CHECKPOINT, "pt") as file:
        one, other = json.loads(file.metadata()["positions"])
    assert one["step"] == other["step"] == 2
    run = TrainRun(tmp_path / "parts", pool_file, "cpu", validate=False)
    alone = replace(settings, gpus=1, fresh=settings.fresh / 2)
    (tmp_path / "alone").mkdir()
    train_pictures(alone, replace(run, folder=tmp_path / "alone"), lambda _: None)
    single = load_file(tmp_path / "alone" / CHECKPOINT)
    differs = [name for name, tensor in whole.items() if not torch.equal(tensor, single[name])]
    assert len(differs) > 20, "each process has scenes of its own: the mean is not what one of them learns"
    with pytest.raises(InputError, match="is of another training"):
        train_pictures(replace(settings, gpus=1), run, lambda _: None)
