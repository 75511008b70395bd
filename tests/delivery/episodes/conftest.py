"""One small dataset with recordings for all tests of episodes."""

from pathlib import Path

import pytest

from tests.helpers.recorded_dataset import two_scenes


@pytest.fixture(scope="package")
def out(tmp_path_factory) -> Path:
    return two_scenes(tmp_path_factory.mktemp("episodes") / "out")
