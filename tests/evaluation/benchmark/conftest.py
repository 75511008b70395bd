"""One dataset and its benchmark for all tests of benchmarks."""

from pathlib import Path

import pytest

from tableverse_factory import open_dataset
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.evaluation.benchmark.benchmark import Benchmark
from tableverse_factory.evaluation.benchmark.make import BenchmarkSettings, make_benchmark
from tests.helpers.learnable_dataset import write_learnable_dataset


@pytest.fixture(scope="session")
def out(tmp_path_factory) -> Path:
    """Three scenes with a solved task each, two of them of the test split; nobody writes into it."""
    folder = tmp_path_factory.mktemp("benchmark") / "out"
    return write_learnable_dataset(folder, scenes=3, moved=3, splits=("test", "train", "test"))


@pytest.fixture(scope="session")
def dataset(out) -> Dataset:
    return open_dataset(out)


@pytest.fixture(scope="session")
def benchmark(dataset) -> Benchmark:
    """An episode of training, two of the test split, and one of those along each axis."""
    return make_benchmark(dataset, BenchmarkSettings(perturbed=1))
