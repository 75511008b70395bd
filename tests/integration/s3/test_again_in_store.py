"""`--from` into a store: what is stopped gets on with the same command there too."""

from dataclasses import replace

import pytest

from tableverse_factory.core.storage.files import list_names
from tests.helpers.builds import Silent, build, digests, request, write_manifest
from tests.helpers.store_contents import digests_in
from workers.plan.rerun import MARKER
from workers.run import run_build
from workers.state.checkpoint_store import CHECKPOINTS

WHOLE_TIMES = {"deadline_s": 60.0}


@pytest.mark.slow  # test_again_stopped.py does it on the disk
def test_a_stopped_beginning_again_goes_on(store, tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine", "sad", "fine", "fine", "fine"])
    build(manifest, tmp_path / "out", **WHOLE_TIMES)
    asked = replace(request(manifest, tmp_path / "x", **WHOLE_TIMES), out=store)
    run_build(asked, Silent())
    again = replace(asked, from_stage="export")
    assert run_build(replace(again, limit=3), Silent()).tally.before == 1
    assert MARKER in list_names(store / ".work")
    assert run_build(again, Silent()).tally.before == 4
    assert MARKER not in list_names(store / ".work")
    dataset = {name: digest for name, digest in digests_in(store).items() if not name.startswith(CHECKPOINTS)}
    assert dataset == digests(tmp_path / "out")
