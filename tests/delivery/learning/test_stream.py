"""Streams of scenes: each scene once whoever reads, the same order for the same seed, going on where one stopped."""

import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory import SceneStream, open_dataset
from tableverse_factory.core.errors import ConfigError, InputError, QueryError
from tableverse_factory.delivery.learning.stream import shuffle_epoch, take_part
from tests.helpers.recorded_dataset import write_recorded_dataset

IDS = [f"s-{k}" for k in range(7)]


def ids(items):
    return [item["scene_id"] for item in items]


@given(
    st.lists(st.integers(0, 9), max_size=60).map(sorted),
    st.integers(0, 5),
    st.integers(0, 100),
    st.integers(1, 7),
    st.booleans(),
)
def test_any_division_holds_every_scene_once(shards, seed, buffer, parts, even):
    ordered = shuffle_epoch(np.array(shards, dtype=np.int64), seed, 3, buffer)
    assert sorted(ordered.tolist()) == list(range(len(shards)))
    taken = [take_part(ordered, k, parts, parts if even else 1).tolist() for k in range(parts)]
    everything = sorted(number for part in taken for number in part)
    assert len(everything) == len(set(everything)) == (len(shards) - len(shards) % parts if even else len(shards))
    assert len({len(part) for part in taken}) == 1 or (not even and np.ptp([len(part) for part in taken]) == 1)


def test_a_buffer_keeps_neighbours_in_few_shards():
    """What is read one after another lies in the shards that the buffer reaches."""
    shards = np.repeat(np.arange(50), 64)
    ordered = shuffle_epoch(shards, 0, 0, 128)
    windows = [len(set(shards[ordered[k : k + 64]])) for k in range(0, 3200, 64)]
    assert np.median(windows) <= 10
    assert len(set(shards[shuffle_epoch(shards, 0, 0, 3200)[:64]])) > 25
    assert shards[ordered[:64]].min() != 0 or shards[ordered[-64:]].max() != 49


def test_the_same_seed_gives_the_same_items_and_another_epoch_another_order(out):
    stream = SceneStream(out, seed=4)
    first = list(stream)
    assert sorted(ids(first)) == IDS
    for again in (stream, SceneStream(out, seed=4)):
        for a, b in zip(first, again, strict=True):
            assert a["scene_id"] == b["scene_id"]
            assert np.array_equal(a["poses"], b["poses"])
            assert a["labels"] == b["labels"]
    stream.set_epoch(1)
    assert sorted(ids(stream)) == IDS
    assert ids(stream) != ids(first)
    assert ids(SceneStream(out, seed=5)) != ids(first)
    assert ids(SceneStream(out, shuffle=0)) == IDS


def test_items_are_what_the_scene_holds(out):
    parts = ("photograph", "masks", "ids", "poses", "meta", "xml", "files", "motions")
    item = next(iter(SceneStream(out, parts, columns=("licence", "quality_score"), shuffle=0)))
    scene = open_dataset(out).scene("s-0")
    assert (item["licence"], item["quality_score"]) == ("CC0-1.0", 7)
    assert item["photograph"].shape == (48, 64, 3)
    assert np.abs(item["photograph"].astype(int) - (0, 100, 200)).max() < 4
    assert item["masks"].dtype == np.int32
    assert (item["masks"] == 1).sum() == 16 * 32
    assert item["ids"] == ["obj_000", "obj_001", "obj_002"]
    assert (item["meta"], item["xml"], item["files"]) == (scene.meta, scene.xml, scene.files())
    model = scene.model()
    assert np.abs(item["poses"] - model.qpos0.reshape(3, 7)).max() < 1e-6
    done, failed = item["motions"]
    assert (done["success"], failed["success"]) == (True, False)
    assert done["command"].shape == (len(done["qpos"]), 8)
    assert np.array_equal(done["qpos"], scene.trajectory("task_000").recording().qpos)


def test_a_scene_without_a_picture_has_none(tmp_path):
    item = next(iter(SceneStream(write_recorded_dataset(tmp_path / "out", {"a-1": []}), ("photograph", "masks"))))
    assert item == {"scene_id": "a-1", "photograph": None, "masks": None}


@pytest.mark.parametrize("stop", [0, 1, 4, 7])
def test_it_goes_on_where_it_stopped(out, stop):
    stream = SceneStream(out, ("labels",), seed=2)
    stream.set_epoch(3)
    whole = ids(stream)
    running = iter(stream)
    before = [next(running)["scene_id"] for _ in range(stop)]
    state = json.loads(json.dumps(stream.state_dict()))
    other = SceneStream(out, ("labels",), seed=2)
    other.load_state_dict(state)
    assert other.state_dict() == state
    assert before + ids(other) == whole
    assert ids(other) == whole, "and then begins anew"


def test_an_iteration_that_was_left_early_costs_no_scene(out):
    stream, other = SceneStream(out, ("labels",), seed=2), SceneStream(out, ("labels",), seed=2)
    running = iter(stream)
    ids(next(running) for _ in range(4))
    begun = iter(stream)
    assert stream.state_dict()["given"] == 0, "a new iteration has given nothing yet"
    next(begun)
    assert ids([next(running)]), "the old one goes on,"
    assert stream.state_dict()["given"] == 1, "but the state is that of the new one"
    stream.set_epoch(1)
    state = stream.state_dict()
    assert (state["epoch"], state["given"]) == (1, 0)
    next(begun)
    assert stream.state_dict() == state
    other.load_state_dict(state)
    assert ids(other) == ids(stream)
    assert len(ids(other)) == 7


def test_another_epoch_than_that_of_the_state_starts_at_its_first_scene(out):
    stream, other = SceneStream(out, ("labels",), seed=2), SceneStream(out, ("labels",), seed=2)
    running = iter(stream)
    before = ids(next(running) for _ in range(4))
    other.load_state_dict(stream.state_dict())
    other.set_epoch(0)
    assert before + ids(other) == ids(stream), "the same epoch goes on"
    other.load_state_dict({**stream.state_dict(), "given": 4})
    other.set_epoch(1)
    stream.set_epoch(1)
    assert ids(other) == ids(stream)


def test_a_state_of_something_else_is_refused(out):
    state = SceneStream(out, seed=1).state_dict()
    others = [
        SceneStream(out, seed=2),
        SceneStream(out, shuffle=2, seed=1),
        SceneStream(out, condition="scene_id != 's-3'", seed=1),
        SceneStream(out, seed=1).part(0, 2),
    ]
    for other in others:
        with pytest.raises(InputError, match="other scenes, with another shuffle or seed, or of another part"):
            other.load_state_dict(state)
    for nonsense in ({}, {**state, "given": -1}, {**state, "epoch": "1"}, {**state, "epoch": None}, []):
        with pytest.raises(InputError, match="no state of a stream"):
            SceneStream(out, seed=1).load_state_dict(nonsense)


def test_a_stream_travels_into_another_process(out):
    stream = SceneStream(out, ("labels",), condition="scene_id != 's-3'").part(1, 2)
    next(iter(stream))
    copied = pickle.loads(pickle.dumps(stream))
    assert ids(copied) == ids(stream)
    assert len(copied) == 3


def test_parts_of_parts_are_parts(out):
    stream = SceneStream(out, ("labels",))
    ranks = [stream.part(rank, 2, even=True) for rank in range(2)]
    assert [len(rank) for rank in ranks] == [3, 3]
    workers = [ids(rank.part(worker, 3)) for rank in ranks for worker in range(3)]
    assert [len(worker) for worker in workers] == [1] * 6
    assert sorted(name for worker in workers for name in worker) == sorted(ids(ranks[0]) + ids(ranks[1]))
    with pytest.raises(ConfigError, match="divide the whole"):
        stream.part(0, 2).part(0, 2, even=True)
    with pytest.raises(ConfigError, match="part 2 of 2"):
        stream.part(2, 2)


def test_what_cannot_be_is_said(out, tmp_path):
    with pytest.raises(ConfigError, match=r"no part 'photo' of a scene; there are photograph, masks"):
        SceneStream(out, ("photo",))
    with pytest.raises(ConfigError, match="whole numbers"):
        SceneStream(out, seed=-1)
    with pytest.raises(QueryError, match="usable"):
        SceneStream(out, condition="usabel")
    with pytest.raises(QueryError, match="no column"):
        SceneStream(out, columns=("colour",))
    with pytest.raises(InputError, match="no such folder"):
        SceneStream(tmp_path / "nowhere")


def test_a_scene_without_poses_is_said(tmp_path):
    path = write_recorded_dataset(tmp_path / "out", {"a-1": []})
    stream = SceneStream(path)
    with pytest.raises(InputError, match=r"scene a-1: meta.json has no settled pose of obj_000"):
        next(iter(stream))
