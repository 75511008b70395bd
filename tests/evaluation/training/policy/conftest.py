"""One demonstration by hand, packed, and networks of few channels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tableverse_factory import open_dataset
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import SPLITS
from tests.helpers.learnable_dataset import write_learnable_dataset


@pytest.fixture(scope="package")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two scenes, of which the first has a motion that succeeds and one that fails."""
    return open_dataset(write_learnable_dataset(tmp_path_factory.mktemp("policy") / "out", scenes=2))


@pytest.fixture(scope="package")
def packed(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of its demonstrations, none of them held out."""
    from tableverse_factory.evaluation.training.policy.pack import pack_demonstrations

    path = tmp_path_factory.mktemp("packed") / "demonstrations.npz"
    own = pack_demonstrations([dataset], tuple(SPLITS))
    replace(own, held_out=np.zeros_like(own.held_out)).write(path)
    return path


@pytest.fixture
def thin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of the same layers, but narrow and few, without dropout."""
    pytest.importorskip("torch", reason="the extra `models` is not installed")
    from tableverse_factory.evaluation.training.policy import network

    small = {"WIDTH": 48, "HEADS": 4, "ENCODER": 1, "DECODER": 1, "MOTION": 1, "DROPOUT": 0.0}
    for name, value in small.items():
        monkeypatch.setattr(network, name, value)
