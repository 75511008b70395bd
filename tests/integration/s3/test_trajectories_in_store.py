"""A dataset in a store grows by its trajectories as one on a disk does."""

from dataclasses import replace

import pytest

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.rebuild import config_from_run
from tableverse_factory.run_record import read_run
from tests.helpers.builds import Silent, digests, request, write_manifest
from tests.helpers.store_contents import digests_in
from workers.run import run_build
from workers.state.checkpoint_store import CHECKPOINTS

WHOLE_TIMES = {"deadline_s": 60.0}


@pytest.mark.slow
def test_it_grows_without_its_manifest_and_goes_on_after_a_stop(store, tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine", "sad", "fine", "idle", "fine"])
    asked = replace(request(manifest, tmp_path / "out", **WHOLE_TIMES), pipeline="tests.helpers.long_pipeline:LONG")
    run_build(asked, Silent())
    run_build(replace(asked, out=store, pipeline="tests.helpers.long_pipeline:SHORT", keep=False), Silent())
    config = config_from_run(read_run(store / "run.json"), "trajectories")
    afterwards = replace(asked, out=store, manifest=None, config=config)
    assert run_build(replace(afterwards, limit=2), Silent()).tally.before == 1
    assert run_build(afterwards, Silent()).tally.before == 3
    dataset = {name: digest for name, digest in digests_in(store).items() if not name.startswith(CHECKPOINTS)}
    assert dataset == digests(tmp_path / "out")
    assert open_dataset(str(store)).trajectories.count_rows() == 6
    assert len(open_dataset(str(store)).scene("scene_000").trajectories()) == 2
