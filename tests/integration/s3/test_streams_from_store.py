"""Scenes stream out of a store as they do from the disk, also into workers that were forked while it was open."""

import pytest
from torch.utils.data import DataLoader

from tableverse_factory import SceneDataset, SceneStream
from tableverse_factory.core.storage.files import get_store
from tests.helpers.learnable_dataset import write_learnable_dataset


@pytest.mark.parametrize(("workers", "context"), [pytest.param(0, None, marks=pytest.mark.slow), (2, "fork")])
def test_a_stream_reads_a_store(store, tmp_path, workers, context):
    here = write_learnable_dataset(tmp_path / "out", scenes=3)
    for path in here.rglob("*"):
        if path.is_file():
            get_store(store).pipe_file(f"{store.path}/{path.relative_to(here)}", path.read_bytes())
    parts = ("photograph", "poses", "motions")
    local = {item["scene_id"]: item for item in SceneStream(here, parts)}
    dataset = SceneDataset(SceneStream(str(store), parts))
    list(dataset)  # the parent's connections are open
    how = {"multiprocessing_context": context} if workers else {}
    items = list(DataLoader(dataset, batch_size=None, num_workers=workers, timeout=60 if workers else 0, **how))
    assert sorted(item["scene_id"] for item in items) == ["s-0", "s-1", "s-2"]
    for item in items:
        there = local[item["scene_id"]]
        assert (item["photograph"].numpy() == there["photograph"]).all()
        assert (item["poses"].numpy() == there["poses"]).all()
        assert len(item["motions"]) == len(there["motions"])
