"""Resume points of scenes: the last readable checkpoint, with the costs before it."""

import pytest

from schemas.codec import decode, encode
from schemas.manifest import ImageRow
from schemas.outcome import ModelCost
from tableverse_factory.core.errors import BuildError
from tests.helpers.fake_executor import STAGES, FakeLedger, make_rows, make_spec
from workers.driver.checkpoints import CheckpointIndex
from workers.state.checkpoint_store import CheckpointStore, name_cost_checkpoint


@pytest.fixture
def names(tmp_path):
    """Names of the checkpoints of scene 0."""
    return CheckpointIndex(make_spec(tmp_path, make_rows(1)), FakeLedger(1)).start(0).records


def start(tmp_path, **options):
    spec = make_spec(tmp_path, make_rows(1), **options)
    return CheckpointIndex(spec, FakeLedger(1)).start(0)


def test_a_new_scene_starts_at_its_row(tmp_path):
    scene = start(tmp_path)
    assert (scene.position, scene.input_record) == (0, "")
    assert isinstance(decode(scene.payload), ImageRow)
    assert scene.records[-1] == "", "the last output is the result"


def test_a_scene_starts_behind_its_last_checkpoint(tmp_path, names):
    store = CheckpointStore(tmp_path / ".stages")
    store.write(names[0], b"first")
    store.write(name_cost_checkpoint(names[0]), encode(ModelCost(calls=2)))
    store.write(names[1], b"second")
    scene = start(tmp_path)
    assert (scene.position, scene.payload) == (2, b"")
    assert store.read(scene.input_record) == b"second"
    assert scene.costs == {STAGES[0].name: ModelCost(calls=2)}


def test_an_unreadable_checkpoint_moves_the_scene_back(tmp_path, names):
    for name in names[:2]:
        store = CheckpointStore(tmp_path / ".stages")
        store.write(name, b"output")
        store.close()
    index = CheckpointIndex(make_spec(tmp_path, make_rows(1)), FakeLedger(1))
    scene = index.start(0)
    assert scene.position == 2
    second = max((tmp_path / ".stages").rglob("*.pack"), key=lambda path: path.stat().st_mtime_ns)
    second.write_bytes(second.read_bytes()[:-1])
    index.resume([scene], inputs_lost=True)
    assert scene.position == 1


def test_a_scene_without_a_loss_is_not_moved_back(tmp_path, names):
    spec = make_spec(tmp_path, make_rows(1))
    index = CheckpointIndex(spec, FakeLedger(1))
    scene = index.start(0)
    scene.position, scene.payload = 2, b"in memory"
    index.resume([scene], inputs_lost=False)
    assert (scene.position, scene.payload) == (2, b"in memory")


def test_added_stages_refuse_to_compute_a_scene_from_its_picture(tmp_path):
    with pytest.raises(BuildError, match=r"s0: look would have to run again"):
        start(tmp_path, added_only=True)
