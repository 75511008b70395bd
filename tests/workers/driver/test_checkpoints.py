"""Resume points of scenes: the last readable checkpoint, with the costs before it."""

import numpy as np
import pytest

from schemas.outcome import ModelCost
from tableverse_factory.core.errors import BuildError
from tests.helpers.fake_executor import STAGES, make_rows, make_spec
from workers.driver.checkpoints import CheckpointIndex
from workers.state.checkpoint_store import CheckpointStore, name_cost_checkpoint


@pytest.fixture
def names(tmp_path):
    """Names of the checkpoints of scene 0."""
    return CheckpointIndex(make_spec(tmp_path, make_rows(1))).start(0).records


def start(tmp_path, **options):
    spec = make_spec(tmp_path, make_rows(1), **options)
    return CheckpointIndex(spec).start(0)


def test_a_new_scene_starts_at_its_row(tmp_path):
    scene = start(tmp_path)
    assert (scene.position, scene.input) == (0, "")
    assert scene.records[-1] == "", "the last output is the result"


def test_a_scene_starts_behind_its_last_checkpoint(tmp_path, names):
    store = CheckpointStore(tmp_path / ".stages")
    store.write(names[0], "first")
    store.write(name_cost_checkpoint(names[0]), ModelCost(calls=2))
    store.write(names[1], b"second")
    scene = start(tmp_path)
    assert scene.position == 2
    assert store.read(scene.input).record == b"second"
    assert scene.costs == {STAGES[0].name: ModelCost(calls=2)}


def test_an_unreadable_checkpoint_moves_the_scene_back(tmp_path, names):
    for name in names[:2]:
        store = CheckpointStore(tmp_path / ".stages")
        store.write(name, b"output")
    index = CheckpointIndex(make_spec(tmp_path, make_rows(1)))
    scene = index.start(0)
    assert scene.position == 2
    second = max((tmp_path / ".stages").rglob("*.pack"), key=lambda path: path.stat().st_mtime_ns)
    second.write_bytes(second.read_bytes()[:-1])
    index.resume([scene])
    assert scene.position == 1


def test_a_checkpoint_without_the_one_that_it_refers_to_is_missing(tmp_path, names):
    shared = np.arange(1000)
    first, second = (CheckpointStore(tmp_path / ".stages") for _ in range(2))
    parent = first.write(names[0], (shared,))
    child = second.write(names[1], {"mesh": shared, "of": "the same"}, parent)
    reader = CheckpointStore(tmp_path / ".stages")
    assert np.array_equal(reader.read(child.name).record["mesh"], shared)
    assert reader.read(child.name).blobs.keys() == parent.blobs.keys(), "it is stored once"
    reader.delete(0, {STAGES[0].name})
    assert reader.read(child.name) is None
    assert start(tmp_path).position == 2, "as far as names tell"
    index = CheckpointIndex(make_spec(tmp_path, make_rows(1)))
    scene = index.start(0)
    index.resume([scene])
    assert scene.position == 0


def test_added_stages_refuse_to_compute_a_scene_from_its_picture(tmp_path):
    with pytest.raises(BuildError, match=r"s0: look would have to run again"):
        start(tmp_path, added_only=True)
