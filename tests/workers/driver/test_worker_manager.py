"""Who comes in whose place, and that a build ends wherever its workers can be placed, one after the other at least."""

import itertools
import random
from collections import Counter

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from schemas.work import StageChainReport, StageReport
from workers.driver.worker_manager import PLACEMENT_TIMEOUT_S, WorkerManager
from workers.executors.pool_capacity import count_actors
from workers.executors.protocol import CallFinished, JobResult, WorkerLost, WorkerReady
from workers.executors.schedule import PoolLimits, ReadyScene, ScheduleLimits


class Hall:
    """An executor whose workers exist by name only."""

    def __init__(self, recycle_after: int) -> None:
        self.limits = ScheduleLimits({"physics": PoolLimits({"CPU": 1.0}, recycle_after=recycle_after)}, {"CPU": 2.0})
        self._numbers = itertools.count()

    def start(self, pool):
        return next(self._numbers)

    def submit(self, worker, jobs):
        pass

    def retire(self, worker):
        pass


def serve(crew: WorkerManager, ranks: list[int]) -> None:
    crew.dispatch([ReadyScene(rank, "physics", 1) for rank in ranks], lambda rank: rank)


def test_only_what_replaces_another_worker_is_a_restart():
    crew = WorkerManager(Hall(recycle_after=2), ["physics"])
    serve(crew, [0, 1])
    assert (crew.alive["physics"], crew.restarts) == (2, 0)
    for worker in (0, 1):
        crew.on_event(WorkerReady(worker))
    serve(crew, [0, 1])
    crew.on_event(WorkerLost(0, (), "its node is gone"))
    assert crew.restarts == 0
    serve(crew, [0])
    assert (crew.alive["physics"], crew.restarts) == (2, 1)
    crew.on_event(CallFinished(1, tuple(JobResult(rank, StageChainReport(())) for rank in (1, 2))))
    assert crew.alive["physics"] == 1
    serve(crew, [3, 4])
    assert (crew.alive["physics"], crew.restarts) == (2, 2)


class Cluster:
    """An executor whose workers are placed on nodes, each on the first with room; those without one wait, as Ray's do.

    Nobody is told of an idle worker whose node is lost: its next call fails.
    """

    def __init__(self, nodes: list[int], needs: dict[str, int], least: dict[str, int], chance: random.Random) -> None:
        self.nodes = dict(enumerate(nodes))
        self.needs, self._least, self._chance = needs, least, chance
        self._pool: dict[int, str] = {}
        self.node_of: dict[int, int] = {}
        self.pending: list[int] = []
        self.calls: dict[int, tuple[int, ...]] = {}
        self.answers: dict[int, int] = {}

    @property
    def limits(self) -> ScheduleLimits:
        pools = {}
        for pool, need in self.needs.items():
            room = sum(count_actors({"CPU": float(have)}, {"CPU": float(need)}) for have in self.nodes.values())
            pools[pool] = PoolLimits({"CPU": float(need)}, self._least[pool], room, batch=2)
        return ScheduleLimits(pools, {"CPU": float(sum(self.nodes.values()))})

    def start(self, pool):
        number = len(self._pool)
        self._pool[number] = pool
        self.pending.append(number)
        return number

    def submit(self, worker, jobs):
        assert worker in self.node_of
        assert worker not in self.calls
        self.calls[worker] = jobs

    def retire(self, worker):
        assert worker not in self.calls
        del self.node_of[worker]

    def lose(self, node: int) -> None:
        del self.nodes[node]

    def events(self) -> list:
        """Places whom it can, in any order, and ends one call; calls on lost nodes are lost."""
        placed = []
        for worker in self._chance.sample(self.pending, len(self.pending)):
            used = Counter()
            for other, node in self.node_of.items():
                used[node] += self.needs[self._pool[other]]
            need = self.needs[self._pool[worker]]
            fits = [node for node, have in self.nodes.items() if used[node] + need <= have]
            if fits:
                self.node_of[worker] = fits[0]
                placed.append(worker)
        self.pending = [worker for worker in self.pending if worker not in placed]
        lost = [worker for worker in self.calls if self.node_of[worker] not in self.nodes]
        for worker in lost:
            del self.node_of[worker]
        events = [WorkerReady(worker) for worker in placed]
        events += [WorkerLost(worker, self.calls.pop(worker), "its node is gone") for worker in lost]
        if self.calls:
            worker = self._chance.choice(sorted(self.calls))
            answers = tuple(JobResult(rank, StageChainReport(())) for rank in self.calls.pop(worker))
            events.append(CallFinished(worker, answers))
        return events


def build(cluster: Cluster, stages: list[str], n: int, lose_at: int | None = None) -> list[float]:
    """Takes scenes through their stages as the driver does; the times at which something moved [s]."""
    now, moved, most = 0.0, [0.0], 0
    crew = WorkerManager(cluster, sorted(set(stages)), lambda: now)
    todo, position, running = list(range(n)), {}, set()
    while todo or position:
        while todo and len(position) < crew.max_in_flight:
            position[todo.pop(0)] = 0
        waiting = [
            ReadyScene(rank, stages[at], len(stages) - at) for rank, at in position.items() if rank not in running
        ]
        running |= set(crew.dispatch(waiting, lambda rank: rank))
        for event in cluster.events():
            crew.on_event(event)
            if isinstance(event, WorkerLost):
                running -= set(event.work)
            if isinstance(event, CallFinished):
                moved.append(now)
                most = 0
                for answer in event.answers:
                    running.discard(answer.rank)
                    position[answer.rank] += 1
                    if position[answer.rank] == len(stages):
                        del position[answer.rank]
        if lose_at == len(moved) and len(cluster.nodes) > 1:
            largest = max(cluster.nodes, key=lambda node: cluster.nodes[node])
            cluster.lose(next(node for node in cluster.nodes if node != largest))
        most = max(most, len(cluster.node_of) + len(cluster.pending))
        assert now - moved[-1] <= (most + 1) * (PLACEMENT_TIMEOUT_S + 2.0), (
            "stuck for longer than it takes to let all go"
        )
        now += 1.0
    return moved


needs = st.dictionaries(st.sampled_from("abcd"), st.integers(1, 4), min_size=1)


@pytest.mark.heavy
@given(
    needs=needs,
    nodes=st.lists(st.integers(1, 8), min_size=1, max_size=4),
    least=st.lists(st.integers(0, 3), min_size=4, max_size=4),
    n=st.integers(1, 25),
    lose_at=st.none() | st.integers(1, 30),
    seed=st.integers(0, 2**32),
    data=st.data(),
)
def test_every_scene_ends_if_each_pool_fits_on_some_node(needs, nodes, least, n, lose_at, seed, data):
    assume(max(needs.values()) <= max(nodes))
    stages = data.draw(st.lists(st.sampled_from(sorted(needs)), min_size=1, max_size=6))
    mins = dict(zip("abcd", least, strict=True))
    build(Cluster(nodes, needs, {pool: mins[pool] for pool in needs}, random.Random(seed)), stages, n, lose_at)


def test_pools_that_fit_by_sums_and_not_by_nodes_are_stuck_once():
    """Two nodes of 3 CPUs, two pools of 2: sizes 2 + 1 by sums, 1 + 1 in truth; who makes way stays away."""
    cluster = Cluster([3, 3], {"a": 2, "b": 2}, {"a": 0, "b": 0}, random.Random(0))
    moved = build(cluster, ["a", "b"], 100)
    pauses = [after - before for before, after in itertools.pairwise(moved)]
    assert sum(pause > 5.0 for pause in pauses) == 1
    assert max(pauses) < PLACEMENT_TIMEOUT_S + 5.0


def test_who_takes_seconds_to_start_sends_nobody_away():
    now = [0.0]
    cluster = Cluster([2], {"a": 1, "b": 1}, {"a": 0, "b": 0}, random.Random(0))
    crew = WorkerManager(cluster, ["a", "b"], lambda: now[0])
    crew.dispatch([ReadyScene(0, "a", 2)], lambda rank: rank)
    for event in cluster.events():
        crew.on_event(event)
    for now[0], alive in (
        (1.0, {"a": 1, "b": 1}),
        (11.0, {"a": 1, "b": 1}),
        (21.0, {"a": 1, "b": 1}),
        (21.5, {"b": 1}),
    ):
        crew.dispatch([ReadyScene(0, "b", 1)], lambda rank: rank)
        assert crew.alive == alive


def test_when_a_node_is_gone_the_sizes_follow_without_a_call_that_ends():
    cluster = Cluster([2, 2], {"a": 1, "b": 1}, {"a": 0, "b": 0}, random.Random(0))
    crew = WorkerManager(cluster, ["a", "b"], lambda: 0.0)
    assert crew.sizes == {"a": 2, "b": 2}
    cluster.lose(1)
    crew.dispatch([], lambda rank: rank)
    assert crew.sizes == {"a": 1, "b": 1}


def test_a_node_that_joins_ends_what_was_learned_of_room():
    now = [0.0]
    cluster = Cluster([3, 3], {"a": 2, "b": 2}, {"a": 2, "b": 0}, random.Random(0))
    crew = WorkerManager(cluster, ["a", "b"], lambda: now[0])
    for event in cluster.events():
        crew.on_event(event)
    for now[0], size in ((0.0, 2), (20.0, 2), (20.5, 1)):
        crew.dispatch([ReadyScene(0, "b", 1)], lambda rank: rank)
        assert crew.sizes["a"] == size
    cluster.nodes[2] = 3
    crew.dispatch([ReadyScene(0, "b", 1)], lambda rank: rank)
    assert crew.sizes["a"] == 2


def test_who_is_there_stays_rather_than_who_has_found_no_place():
    hall = Hall(recycle_after=0)
    crew = WorkerManager(hall, ["physics"])
    serve(crew, [0, 1])
    crew.on_event(WorkerReady(0))
    hall.limits = ScheduleLimits(hall.limits.pools, {"CPU": 1.0})
    assert crew.dispatch([ReadyScene(0, "physics", 1)], lambda rank: rank) == (0,)
    crew.on_event(WorkerReady(1))
    serve(crew, [])
    assert crew.alive["physics"] == 1


def test_after_a_loss_the_sizes_follow_what_is_known():
    crew = WorkerManager(Cluster([4], {"a": 1, "b": 1}, {"a": 0, "b": 0}, random.Random(0)), ["a", "b"])
    crew.dispatch([ReadyScene(0, "a", 2), ReadyScene(1, "b", 1)], lambda rank: rank)
    slow = StageChainReport((StageReport(None, 1, 100.0, 100.0),))
    crew.on_event(WorkerReady(0))
    crew.on_event(CallFinished(0, (JobResult(0, slow),)))
    crew.dispatch([], lambda rank: rank)
    assert crew.sizes == {"a": 2, "b": 2}
    crew.on_event(WorkerLost(1, (), "its node is gone"))
    crew.dispatch([], lambda rank: rank)
    assert crew.sizes == {"a": 3, "b": 1}
