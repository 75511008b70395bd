"""Streams in PyTorch's own `DataLoader`: real workers, forked and spawned, every scene once, going on after a stop."""

import json
import pickle
import sys

import pytest
import torch
from torch.testing._internal.distributed.fake_pg import FakeStore
from torch.utils.data import DataLoader

import tableverse_factory
from tableverse_factory import SceneDataset, SceneStream
from tableverse_factory.core.errors import ConfigError, InputError

IDS = [f"s-{k}" for k in range(7)]
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create 3 worker processes")


def loaded(dataset, workers, context=None):
    how = {"multiprocessing_context": context} if workers else {}
    return list(DataLoader(dataset, batch_size=None, num_workers=workers, **how))


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("workers", "context"), [(0, None), (1, "fork"), (3, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)]
)
def test_every_scene_comes_once_and_in_the_same_order_again(out, workers, context):
    dataset = SceneDataset(SceneStream(out, ("photograph", "poses", "motions"), columns=("licence",), seed=1))
    items = loaded(dataset, workers, context)
    ids = [item["scene_id"] for item in items]
    assert sorted(ids) == IDS
    assert len(dataset) == 7
    alone = {item["scene_id"]: item for item in loaded(dataset, 0)}
    for item in items:
        assert isinstance(item["photograph"], torch.Tensor)
        assert torch.equal(item["photograph"], alone[item["scene_id"]]["photograph"])
        assert torch.equal(item["poses"], alone[item["scene_id"]]["poses"])
        assert item["licence"] == alone[item["scene_id"]]["licence"]
    assert {item["scene_id"]: len(item["motions"]) for item in items} == {**dict.fromkeys(IDS, 0), "s-0": 2}
    if context != "spawn":
        assert [item["scene_id"] for item in loaded(dataset, workers, context)] == ids
        dataset.set_epoch(1)
        following = [item["scene_id"] for item in loaded(dataset, workers, context)]
        assert sorted(following) == IDS
        assert following != ids


@pytest.mark.heavy
@pytest.mark.parametrize("even", [False, True])
def test_ranks_share_nothing_and_miss_nothing(out, even):
    stream = SceneStream(out, ("labels",), seed=3)
    ranks = [
        [item["scene_id"] for item in loaded(SceneDataset(stream, rank, 2, even), workers)]
        for rank, workers in ((0, 3), (1, 0))
    ]
    assert [len(rank) for rank in ranks] == ([3, 3] if even else [4, 3])
    assert len(set(ranks[0] + ranks[1])) == sum(map(len, ranks))
    again = [item["scene_id"] for item in loaded(SceneDataset(stream, 0, 2, even), 0)]
    assert sorted(again) == sorted(ranks[0]), "workers divide what their rank has"


class Worker:
    """What a loader that keeps states does in each of its workers."""

    def __init__(self, dataset, state=None):
        if state is not None:
            dataset.load_state_dict(state)
        self.dataset, self.items = dataset, iter(dataset)

    def take(self, count):
        return [next(self.items)["scene_id"] for _ in range(count)]


def test_a_dataset_goes_on_where_its_state_was_taken(out):
    def dataset():
        return SceneDataset(SceneStream(out, ("labels",), seed=1), 0, 1)

    whole = [item["scene_id"] for item in dataset()]
    first = Worker(dataset())
    before = first.take(3)
    state = json.loads(json.dumps(first.dataset.state_dict()))
    second = Worker(dataset(), state)
    assert second.dataset.state_dict() == state, "also before its first item"
    assert before + second.take(4) == whole
    assert list(second.items) == []
    assert [item["scene_id"] for item in second.dataset] == whole


def test_a_state_goes_on_in_its_own_epoch_alone(out):
    def dataset(epoch):
        made = SceneDataset(SceneStream(out, ("labels",), seed=1), 0, 1)
        made.set_epoch(epoch)
        return made

    whole = [item["scene_id"] for item in dataset(3)]
    first = Worker(dataset(3))
    before = first.take(3)
    state = first.dataset.state_dict()
    second = Worker(dataset(3), state)
    assert before + second.take(4) == whole
    assert [item["scene_id"] for item in second.dataset] == whole
    for epoch in (0, 4):
        with pytest.raises(InputError, match=rf"in the midst of epoch 3, .* is at epoch {epoch}: set_epoch"):
            Worker(dataset(epoch), state)
    for given in (0, 7):
        ended = Worker(dataset(4), {**state, "given": given})
        assert ended.take(7) == [item["scene_id"] for item in dataset(4)], "after the end of one comes the next"


def test_a_dataset_that_was_left_early_begins_its_next_epoch_with_all(out):
    dataset = SceneDataset(SceneStream(out, ("labels",), seed=1))
    Worker(dataset).take(4)
    dataset.set_epoch(1)
    state = dataset.state_dict()
    assert (state["epoch"], state["given"]) == (1, 0)
    assert len(Worker(dataset, state).take(7)) == 7


@pytest.mark.heavy
def test_what_workers_have_given_is_not_told_as_nothing(out):
    dataset = SceneDataset(SceneStream(out, ("labels",), seed=1))
    running = iter(DataLoader(dataset, batch_size=None, num_workers=2, multiprocessing_context="fork"))
    next(running)
    with pytest.raises(ConfigError, match="workers keep their own: give num_workers=0, or take torchdata's"):
        dataset.state_dict()


@pytest.mark.heavy
def test_workers_that_stay_are_refused_in_their_second_epoch(out):
    dataset = SceneDataset(SceneStream(out, ("labels",), seed=1))
    list(dataset)
    loader = DataLoader(
        dataset, batch_size=None, num_workers=1, multiprocessing_context="fork", persistent_workers=True
    )
    assert len(list(loader)) == 7
    dataset.set_epoch(1)
    with pytest.raises(ConfigError, match="persistent_workers=True: workers that stay never hear of set_epoch"):
        list(loader)


@pytest.mark.heavy
def test_a_rank_is_that_of_the_process_when_it_iterates(out, monkeypatch):
    stream = SceneStream(out, ("labels",), seed=3)
    for rank, ranks in ((None, 4), (1, None)):
        with pytest.raises(ConfigError, match=f"rank {rank} of ranks {ranks}: give both or neither"):
            SceneDataset(stream, rank, ranks)
    dataset = SceneDataset(stream)
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ConfigError, match="WORLD_SIZE is 2, but no process group is set up"):
        iter(dataset)
    expected = [item["scene_id"] for item in SceneDataset(stream, 1, 2)]
    torch.distributed.init_process_group("fake", store=FakeStore(), rank=1, world_size=2)
    try:
        assert [item["scene_id"] for item in loaded(dataset, 0)] == expected
        assert [item["scene_id"] for item in loaded(dataset, 1, "fork")] == expected
        spawned = pickle.dumps(dataset)
    finally:
        torch.distributed.destroy_process_group()
    assert [item["scene_id"] for item in pickle.loads(spawned)] == expected


def test_without_torch_it_says_what_to_type(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "tableverse_factory.delivery.learning.loader")
    with pytest.raises(ConfigError, match=r"SceneDataset needs torch: pip install torch$"):
        _ = tableverse_factory.SceneDataset
