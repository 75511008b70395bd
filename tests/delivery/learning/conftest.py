"""One dataset for all tests of learning."""

from pathlib import Path

import pytest

from tests.helpers.learnable_dataset import write_learnable_dataset


@pytest.fixture(scope="session")
def out(tmp_path_factory) -> Path:
    """Seven scenes, `s-0` to `s-6`, in four shards; nobody writes into it."""
    return write_learnable_dataset(tmp_path_factory.mktemp("learning") / "out", scenes=7)
