"""A scene that is looked at across the web costs questions for its own shard alone."""

from collections import Counter

import pyarrow.compute as pc
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.viewer.scene_cache import SceneCache
from tests.helpers.public_dataset import write_public_dataset, write_shard
from tests.helpers.range_server import range_server


@pytest.fixture
def dataset(tmp_path):
    out = write_public_dataset(tmp_path / "out", scenes=2, n_bytes=1000)
    for shard in (1, 2, 3):
        write_shard(out, shard, 2, 1000, "CC-BY-4.0")
    return out


def test_rows_of_a_scene_are_those_of_the_tables(dataset):
    opened = open_dataset(dataset)
    scene = opened.scene("s-1-0")
    mine = pc.field("scene_id") == "s-1-0"
    assert scene.object_rows() == opened.objects.to_table(filter=mine).to_pylist() != []
    assert scene.task_rows() == opened.tasks.to_table(filter=mine).to_pylist()
    (dataset / "objects" / "shard-00001.parquet").unlink()
    with pytest.raises(InputError, match=r"damaged: .*objects/shard-00001.parquet is missing"):
        scene.object_rows()


@pytest.mark.heavy
def test_a_scene_that_is_opened_asks_for_its_own_shard(dataset):
    with range_server(dataset) as server:
        shelf = SceneCache(open_dataset(server.address))
        server.forget()
        assert shelf.find_dropped_row("s-1-0") is None
        scene = shelf.open("s-1-0")
        assert [row["label"] for row in scene.object_rows] == ["mug"]
        assert tuple(scene.scene.task_rows()) == tuple(open_dataset(dataset).scene("s-1-0").task_rows())
        assert tuple(scene.scene.trajectory_rows()) == ()
        tables = {f"{table}/shard-00001.parquet": 1 for table in ("scenes", "objects", "tasks", "trajectories")}
        assert server.asked - Counter(["plan.parquet"]) == {**tables, "mjcf/shard-00001.tar": 1}
