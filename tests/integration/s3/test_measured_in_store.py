"""An estimate stands on the same figures wherever the dataset lies."""

from dataclasses import replace

import numpy as np
import pytest

from tableverse_factory.core.storage.files import get_store
from tests.helpers.builds import Silent, request, write_manifest
from workers.progress.stage_costs import collect_measurements
from workers.run import run_build

POOL_OF = {"look": "perception", "cut": "geometry", "fall": "physics", "pack": "curation"}


@pytest.mark.slow  # tests/workers/progress measures on the disk
def test_the_same_of_a_dataset_in_a_store(store, tmp_path):
    """Two shards, one of them open: its results are read from the segments of its journal."""
    manifest = write_manifest(tmp_path / "m.parquet", ["fine", "empty", "fell", "sad"] * 2)
    asked = replace(request(manifest, tmp_path / "x"), out=store / "out", limit=7)
    run_build(asked, Silent())
    found = collect_measurements(store / "out", POOL_OF)
    assert found.scenes == 7
    assert [stage.name for stage in found.stages] == ["look", "cut", "fall", "pack"]
    assert len(found.storage["scenes"]) == 4
    sizes = get_store(store).list_sizes((store / "out").path, recursive=True)
    tables = ("scenes/", "objects/", "tasks/", "timings/")
    assert found.storage["tables"].sum() == sum(n for name, n in sizes.items() if name.startswith(tables))
    if "stage records" in found.storage:
        assert found.storage["stage records"].sum() > 0

    run_build(replace(asked, limit=None), Silent())
    here = tmp_path / "here"
    for name in get_store(store).list_sizes((store / "out").path, recursive=True):
        path = here / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(get_store(store).cat_file(f"{(store / 'out').path}/{name}"))
    there, copied = collect_measurements(store / "out", POOL_OF), collect_measurements(here, POOL_OF)
    for one, other in zip(there.stages, copied.stages, strict=True):
        assert np.array_equal(one.cpu_s, other.cpu_s)
    assert {k: v.tolist() for k, v in there.storage.items()} == {k: v.tolist() for k, v in copied.storage.items()}
