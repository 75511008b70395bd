"""The schedule as laws: nothing exceeds its limit, everything ends, what is near the end goes first."""

import itertools
import math
from collections import Counter

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from workers.executors.schedule import (
    MAX_BATCH,
    MIN_GAIN,
    PoolLimits,
    ReadyScene,
    ScheduleLimits,
    assign_scenes,
    choose_batch_size,
    compute_max_in_flight,
    compute_min_sizes,
    compute_pool_sizes,
    compute_throughput,
    scale_down,
    scale_up,
)

POOLS = ("perception", "geometry", "physics", "curation")
ready_scenes = st.lists(
    st.builds(
        ReadyScene, rank=st.integers(0, 99), pool=st.sampled_from(POOLS), left=st.integers(1, 7), alone=st.booleans()
    ),
    max_size=40,
    unique_by=lambda scene: scene.rank,
)
small = st.integers(0, 4)
by_pool = st.fixed_dictionaries(dict.fromkeys(POOLS, small))
seconds = st.fixed_dictionaries(dict.fromkeys(POOLS, st.floats(0.001, 100.0)))


def limits_of(needs: dict[str, dict[str, float]], capacity: dict[str, float], **bounds: int) -> ScheduleLimits:
    return ScheduleLimits({name: PoolLimits(need, **bounds) for name, need in needs.items()}, capacity)


@pytest.mark.heavy
@given(ready=ready_scenes, idle=by_pool, busy=by_pool, sizes=by_pool, batch=st.integers(1, 9))
def test_limits_hold_and_nobody_works_twice(ready, idle, busy, sizes, batch):
    workers = {pool: list(range(10 * i, 10 * i + idle[pool])) for i, pool in enumerate(POOLS)}
    alive = {pool: busy[pool] + idle[pool] for pool in POOLS}
    known = {scene.rank: scene for scene in ready}
    chosen = assign_scenes(ready, workers, alive, sizes, dict.fromkeys(POOLS, batch))
    ranks = [rank for _, called in chosen for rank in called]
    taken = [worker for worker, _ in chosen]
    assert len(set(ranks)) == len(ranks)
    assert len(set(taken)) == len(taken)
    gone = scale_down(workers, alive, sizes)
    for worker, called in chosen:
        assert 1 <= len(called) <= batch
        (pool,) = {known[rank].pool for rank in called}
        assert worker in workers[pool]
        assert len(called) == 1 or not any(known[rank].alone for rank in called)
    started = Counter(scale_up(ready, workers, alive, sizes))
    for pool in POOLS:
        assert started[pool] == 0 or alive[pool] + started[pool] <= sizes[pool]
        working = busy[pool] + sum(worker in workers[pool] for worker, _ in chosen)
        assert working <= max(busy[pool], sizes[pool])
        left = alive[pool] - sum(worker in workers[pool] for worker in gone)
        assert left == alive[pool] or left >= sizes[pool]


def test_what_is_near_the_end_goes_first_then_the_order_of_the_plan():
    ready = [ReadyScene(3, "a", 5), ReadyScene(9, "a", 1), ReadyScene(2, "a", 5), ReadyScene(1, "b", 2)]
    chosen = assign_scenes(ready, {"a": [7]}, {"a": 1}, {"a": 2, "b": 1}, {"a": 1, "b": 1})
    assert chosen == ((7, (9,)),)
    assert scale_up(ready, {}, {"a": 1}, {"a": 2, "b": 1}) == ("a", "b")


def test_a_batch_leaves_work_for_the_other_workers():
    ready = [ReadyScene(rank, "a", 1) for rank in range(10)]
    chosen = assign_scenes(ready, {"a": [1, 2]}, {"a": 2}, {"a": 2}, {"a": 64})
    assert [called for _, called in chosen] == [tuple(range(5)), tuple(range(5, 10))]


@pytest.mark.heavy
@given(ready=ready_scenes)
def test_the_order_in_which_scenes_wait_does_not_matter(ready):
    sizes, batches = dict.fromkeys(POOLS, 2), dict.fromkeys(POOLS, 3)
    idle = {pool: [2 * i, 2 * i + 1] for i, pool in enumerate(POOLS)}
    assert assign_scenes(ready, idle, sizes, sizes, batches) == assign_scenes(ready[::-1], idle, sizes, sizes, batches)


@pytest.mark.parametrize(
    ("seconds", "expected"), [(None, 1), (0.0, MAX_BATCH), (0.001, MAX_BATCH), (0.05, 10), (0.3, 1), (100.0, 1)]
)
def test_cheap_scenes_travel_together(seconds, expected):
    assert choose_batch_size(seconds, MAX_BATCH) == expected
    assert choose_batch_size(seconds, 1) == 1


@pytest.mark.heavy
@given(seconds=seconds, cpus=st.integers(4, 30), gpus=st.integers(1, 4))
def test_pools_fit_and_no_other_sizes_are_faster(seconds, cpus, gpus):
    needs = {pool: {"CPU": 1.0} for pool in POOLS} | {"perception": {"CPU": 1.0, "GPU": 0.5}}
    limits = limits_of(needs, {"CPU": float(cpus), "GPU": float(gpus)})
    sizes = compute_pool_sizes(limits, seconds, {})
    assert limits.fits(sizes)
    assert all(size >= 1 for size in sizes.values())
    reached = compute_throughput(sizes, seconds)
    others = (dict(zip(POOLS, counts, strict=True)) for counts in itertools.product(range(1, 8), repeat=4))
    best = max(compute_throughput(other, seconds) for other in others if limits.fits(other)) if cpus <= 12 else reached
    assert reached >= best - 1e-9


@given(seconds=seconds, other=seconds)
def test_pools_are_resized_only_for_a_gain(seconds, other):
    limits = limits_of({pool: {"CPU": 1.0} for pool in POOLS}, {"CPU": 12.0})
    now = compute_pool_sizes(limits, seconds, {})
    then = compute_pool_sizes(limits, other, now)
    assert then == now or compute_throughput(then, other) >= MIN_GAIN * compute_throughput(now, other)


def test_a_single_pool_takes_all_there_is_and_bounds_are_kept():
    assert compute_pool_sizes(limits_of({"all": {"CPU": 1.0}}, {"CPU": 16.0}), {"all": 1.0}, {}) == {"all": 16}
    assert compute_pool_sizes(limits_of({"all": {"CPU": 1.0}}, {"CPU": 16.0}, max_workers=3), {"all": 1.0}, {}) == {
        "all": 3
    }
    assert compute_min_sizes(limits_of({"all": {"CPU": 1.0}}, {"CPU": 16.0}, min_workers=5)) == {"all": 5}


def test_a_resource_that_is_not_there_does_not_fit():
    limits = limits_of({"a": {"GPU": 0.5}, "b": {"CPU": 1.0}}, {"CPU": 4.0})
    assert not limits.fits(compute_min_sizes(limits))
    assert math.isinf(compute_throughput({}, {}))


@pytest.mark.heavy
@given(
    n=st.integers(0, 60),
    stages=st.lists(st.sampled_from(POOLS), min_size=1, max_size=7),
    sizes=st.fixed_dictionaries(dict.fromkeys(POOLS, st.integers(1, 3))),
    batch=st.integers(1, 5),
    data=st.data(),
)
def test_every_scene_ends_whatever_order_calls_return_in(n, stages, sizes, batch, data):
    """A whole build without a cluster: bounded line, lazily made workers, calls that return in any order."""
    assume(stages)
    batches = dict.fromkeys(POOLS, batch)
    line = compute_max_in_flight(sizes, batches)
    todo, position, ended = list(range(n)), {}, set()
    waiting, running, pool_of, idle, starting = set(), {}, {}, set(), set()
    while todo or waiting or running:
        while todo and len(waiting) + sum(map(len, running.values())) < line:
            rank = todo.pop(0)
            position[rank] = 0
            waiting.add(rank)
        ready = [ReadyScene(rank, stages[position[rank]], len(stages) - position[rank]) for rank in waiting]
        free = {pool: [w for w in idle if pool_of[w] == pool] for pool in POOLS}
        alive = {pool: sum(p == pool for p in pool_of.values()) for pool in POOLS}
        for pool in scale_up(ready, free, alive, sizes):
            starting.add(len(pool_of))
            pool_of[len(pool_of)] = pool
        for worker, called in assign_scenes(ready, free, alive, sizes, batches):
            idle.discard(worker)
            waiting -= set(called)
            running[worker] = called
        assert running or starting, "nothing runs although scenes wait"
        for pool in POOLS:
            assert sum(pool_of[worker] == pool for worker in running) <= sizes[pool]
        worker = data.draw(st.sampled_from(sorted(running) + sorted(starting)))
        idle.add(worker)
        starting.discard(worker)
        for rank in running.pop(worker, ()):
            position[rank] += 1
            (waiting if position[rank] < len(stages) else ended).add(rank)
    assert ended == set(range(n))
