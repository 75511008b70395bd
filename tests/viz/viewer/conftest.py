"""A viewer that runs, for all tests of a file."""

import pytest

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.viewer.scene_cache import SceneCache
from tableverse_factory.viz.viewer.server import Viewer
from tests.helpers.viewer_dataset import write_viewed_dataset


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    shelf = SceneCache(open_dataset(write_viewed_dataset(tmp_path_factory.mktemp("viewed") / "out")))
    running = Viewer(shelf, "a-1", "127.0.0.1", 0)
    yield running
    running.stop()
