"""The schedule as laws: nothing exceeds its limit, everything ends, what is near the end goes first."""

from hypothesis import given
from hypothesis import strategies as st

from workers.schedule import Assignment, Limits, Ready, admit, assign, limits_for

POOLS = ("perception", "geometry", "physics", "curation")
ready_scenes = st.lists(
    st.builds(Ready, rank=st.integers(0, 99), pool=st.sampled_from(POOLS), left=st.integers(1, 7)),
    max_size=30,
    unique_by=lambda scene: scene.rank,
)


@given(
    ready=ready_scenes,
    workers=st.dictionaries(st.sampled_from(POOLS), st.integers(0, 4)),
    busy=st.dictionaries(st.sampled_from(POOLS), st.integers(0, 3)),
    calls=st.integers(1, 8),
)
def test_limits_hold(ready, workers, busy, calls):
    idle = {pool: list(range(10 * i, 10 * i + 2)) for i, pool in enumerate(workers)}
    alive = {pool: busy.get(pool, 0) + len(idle.get(pool, ())) for pool in POOLS}
    in_flight = min(calls, sum(busy.values()))
    limits = Limits(calls, workers, line=2 * calls)
    chosen = assign(ready, idle, alive, in_flight, limits)
    assert len(chosen) <= max(0, calls - in_flight)
    assert len({choice.rank for choice in chosen}) == len(chosen)
    known = {scene.rank: scene for scene in ready}
    taken = [choice.worker for choice in chosen if choice.worker is not None]
    assert len(set(taken)) == len(taken)
    for choice in chosen:
        assert choice.pool == known[choice.rank].pool
        assert choice.worker is None or choice.worker in idle[choice.pool]
    for pool in POOLS:
        started = sum(choice.worker is None and choice.pool == pool for choice in chosen)
        assert started == 0 or alive[pool] + started <= workers.get(pool, 0)


def test_what_is_near_the_end_goes_first_then_the_order_of_the_plan():
    ready = [Ready(3, "a", 5), Ready(9, "a", 1), Ready(2, "a", 5), Ready(1, "b", 2)]
    chosen = assign(ready, {"a": [7]}, {"a": 1}, 0, Limits(3, {"a": 2, "b": 1}, 6))
    assert chosen == (Assignment(9, "a", 7), Assignment(1, "b", None), Assignment(2, "a", None))


def test_the_order_in_which_scenes_wait_does_not_matter():
    ready = [Ready(rank, POOLS[rank % 4], 1 + rank % 3) for rank in range(12)]
    limits = limits_for(3, dict.fromkeys(POOLS, 2))
    assert assign(ready, {}, {}, 0, limits) == assign(ready[::-1], {}, {}, 0, limits)


@given(
    n=st.integers(0, 40),
    stages=st.lists(st.sampled_from(POOLS), min_size=1, max_size=7),
    calls=st.integers(1, 5),
    data=st.data(),
)
def test_every_scene_ends_whatever_order_calls_return_in(n, stages, calls, data):
    """A whole build without a cluster: bounded line, lazily made workers, calls that return in any order."""
    limits = limits_for(calls, dict.fromkeys(POOLS, calls))
    todo, position, ended = list(range(n)), {}, set()
    waiting, running, pool_of, idle = set(), {}, {}, set()
    while todo or waiting or running:
        for _ in range(min(len(todo), admit(len(waiting) + len(running), limits))):
            rank = todo.pop(0)
            position[rank] = 0
            waiting.add(rank)
        assert len(waiting) + len(running) <= limits.line
        ready = [Ready(rank, stages[position[rank]], len(stages) - position[rank]) for rank in waiting]
        free = {pool: [w for w in idle if pool_of[w] == pool] for pool in POOLS}
        alive = {pool: sum(p == pool for p in pool_of.values()) for pool in POOLS}
        for choice in assign(ready, free, alive, len(running), limits):
            worker = len(pool_of) if choice.worker is None else choice.worker
            pool_of[worker] = choice.pool
            idle.discard(worker)
            waiting.discard(choice.rank)
            running[choice.rank] = worker
        assert running, "nothing runs although scenes wait"
        assert len(running) <= calls
        rank = data.draw(st.sampled_from(sorted(running)))
        idle.add(running.pop(rank))
        position[rank] += 1
        (waiting if position[rank] < len(stages) else ended).add(rank)
    assert ended == set(range(n))
