"""Streams in PyTorch's own `DataLoader`: real workers, forked and spawned, every scene once, going on after a stop."""

import json

import pytest
import torch
from torch.utils.data import DataLoader

from tableverse_factory.learning import SceneDataset, SceneStream

IDS = [f"s-{k}" for k in range(7)]
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create 3 worker processes")


def loaded(dataset, workers, context=None):
    how = {"multiprocessing_context": context} if workers else {}
    return list(DataLoader(dataset, batch_size=None, num_workers=workers, **how))


@pytest.mark.parametrize(("workers", "context"), [(0, None), (1, "fork"), (3, "fork"), (2, "spawn")])
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
