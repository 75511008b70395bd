"""Who works on what, and how many of each there are: frozen arithmetic over counts, without clocks or Ray."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

TARGET_CALL_S = 0.5
"""Scenes travel in batches that keep a worker busy about so long: a call costs a millisecond, whatever it does [s]."""
MAX_BATCH = 64
MIN_GAIN = 1.25
"""Pools are resized only for a throughput that is better by this factor: starting a worker is dear."""


@dataclass(frozen=True, slots=True)
class PoolLimits:
    """What bounds one pool.

    Attributes:
        needs: What one worker holds, by resource.
        least: Workers that are always there.
        most: Workers at most; None for as many as fit.
        batch: Scenes in one call at most.
        recycle_after: Scenes after which a worker makes way for a new one; 0 for never.
    """

    needs: Mapping[str, float]
    min_workers: int = 0
    max_workers: int | None = None
    batch: int = MAX_BATCH
    recycle_after: int = 0

    def with_cap(self, cap: int | None) -> "PoolLimits":
        """The same with so many workers at most, even where more should always be there; None for no cap."""
        if cap is None:
            return self
        return replace(self, min_workers=min(self.min_workers, cap), max_workers=cap if self.max_workers is None else min(self.max_workers, cap))


@dataclass(frozen=True, slots=True)
class ScheduleLimits:
    """What the schedule may not exceed.

    Attributes:
        pools: ScheduleLimits of each pool.
        capacity: What there is of each resource, for all pools together.
    """

    pools: Mapping[str, PoolLimits]
    capacity: Mapping[str, float]

    def fits(self, sizes: Mapping[str, int]) -> bool:
        """Whether pools of these sizes can be there at once."""
        used: dict[str, float] = {}
        for name, size in sizes.items():
            for resource, amount in self.pools[name].needs.items():
                used[resource] = used.get(resource, 0.0) + size * amount
        within = all(amount <= self.capacity.get(resource, 0.0) + 1e-9 for resource, amount in used.items())
        return within and all(
            most is None or size <= most for name, size in sizes.items() for most in (self.pools[name].max_workers,)
        )


@dataclass(frozen=True, slots=True)
class ReadyScene:
    """A scene inside the line that waits for its next stages.

    Attributes:
        rank: Its rank in the plan.
        pool: Which workers can run them.
        left: Stages left, the next one included.
        alone: Whether it may not share a call: it was in one whose worker was lost.
    """

    rank: int
    pool: str
    left: int
    alone: bool = False


@dataclass(frozen=True, slots=True)
class Assignment:
    """Scenes for one call of a worker."""

    worker: int
    ranks: tuple[int, ...]


def compute_min_sizes(limits: ScheduleLimits) -> dict[str, int]:
    """The smallest pools with which a build can end: one worker each, or as many as are always there."""
    return {name: max(1, pool.min_workers) for name, pool in limits.pools.items()}


def compute_pool_sizes(limits: ScheduleLimits, seconds: Mapping[str, float], now: Mapping[str, int]) -> dict[str, int]:
    """How many workers each pool should have, so that the slowest pool is as fast as it can be.

    From the least sizes on, the pool that would take longest for a scene gets one more worker, until what it needs is
    used up: more of any other would not make the build faster.

    Args:
        limits: What may not be exceeded; the least sizes must fit.
        seconds: Time of one scene in each pool [s].
        now: The present sizes, which stay unless others are better by `MIN_GAIN`.
    """
    best = compute_min_sizes(limits)
    while True:
        slowest = max(sorted(best), key=lambda name: seconds[name] / best[name])
        grown = {**best, slowest: best[slowest] + 1}
        if seconds[slowest] <= 0.0 or not limits.fits(grown):
            break
        best = grown
    stays = now.keys() == best.keys() and all(now.values()) and limits.fits(now)
    return dict(now) if stays and compute_throughput(best, seconds) < MIN_GAIN * compute_throughput(now, seconds) else best


def compute_throughput(sizes: Mapping[str, int], seconds: Mapping[str, float]) -> float:
    """Scenes per second that pools of these sizes can take, all of them busy [1/s]."""
    return min((size / seconds[name] for name, size in sizes.items() if seconds[name] > 0.0), default=math.inf)


def choose_batch_size(seconds: float | None, most: int) -> int:
    """Scenes per call for a pool in which one takes so long; one while nothing is known."""
    return 1 if seconds is None else max(1, min(most, int(TARGET_CALL_S / max(seconds, 1e-6))))


def compute_max_in_flight(sizes: Mapping[str, int], batches: Mapping[str, int]) -> int:
    """Scenes inside the line at once, which bounds what is held in memory: as many may wait as are worked on."""
    return 2 * sum(size * batches[name] for name, size in sizes.items())


def assign_scenes(
    ready: Sequence[ReadyScene],
    idle: Mapping[str, Sequence[int]],
    there: Mapping[str, int],
    sizes: Mapping[str, int],
    batches: Mapping[str, int],
) -> tuple[Assignment, ...]:
    """The next calls: in each pool scenes near the end of the line first, then in the plan's order.

    Finishing before beginning, together with the bounded line, is the back-pressure: a pool whose successors are busy
    gets nothing to do.

    Args:
        ready: Scenes that wait.
        idle: Idle workers of each pool.
        there: Workers of each pool: idle or busy.
        sizes: Workers that each pool should have; those beyond get no work.
        batches: Scenes per call of each pool at most.
    """
    chosen: list[Assignment] = []
    for pool, queue in sorted(_group_by_pool(ready).items()):
        workers = sorted(idle.get(pool, ()))
        fair = math.ceil(len(queue) / max(1, sizes[pool]))
        for worker in workers[: max(0, len(workers) - max(0, there.get(pool, 0) - sizes[pool]))]:
            if not queue:
                break
            chosen.append(Assignment(worker, _take_batch(queue, min(batches[pool], fair))))
    return tuple(chosen)


def scale_up(
    ready: Sequence[ReadyScene], idle: Mapping[str, Sequence[int]], alive: Mapping[str, int], sizes: Mapping[str, int]
) -> tuple[str, ...]:
    """Pools that get one more worker each time they are named: scenes wait for them and none of them is idle.

    Workers that start count as `alive`.
    """
    return tuple(
        pool
        for pool, queue in sorted(_group_by_pool(ready).items())
        if not idle.get(pool)
        for _ in range(min(len(queue), sizes[pool] - alive.get(pool, 0)))
    )


def scale_down(
    idle: Mapping[str, Sequence[int]], there: Mapping[str, int], sizes: Mapping[str, int]
) -> tuple[int, ...]:
    """Idle workers to let go: of pools that have more than they should.

    Only those that are `there` count, idle or busy: one that starts may never find a place.
    """
    return tuple(
        worker
        for pool, workers in sorted(idle.items())
        for worker in sorted(workers)[: max(0, there.get(pool, 0) - sizes[pool])]
    )


def find_preemptible(
    ready: Sequence[ReadyScene], idle: Mapping[str, Sequence[int]], there: Mapping[str, int], overdue: Collection[str]
) -> int | None:
    """An idle worker to let go because scenes wait for a pool that finds no place beside it; None where there is none.

    `ScheduleLimits` are sums over a cluster, and a worker must fit on one node: what fits by sums may not be placed.

    Args:
        ready: Scenes that wait.
        idle: Idle workers of each pool.
        there: Workers of each pool: idle or busy.
        overdue: Pools of which a worker has been starting for too long.
    """
    waited_for = {scene.pool for scene in ready}
    if not any(pool in overdue and not there.get(pool) for pool in waited_for):
        return None
    spare = [pool for pool, workers in sorted(idle.items()) if workers and pool not in waited_for]
    return min(idle[max(spare, key=lambda pool: len(idle[pool]))]) if spare else None


def _group_by_pool(ready: Sequence[ReadyScene]) -> dict[str, list[ReadyScene]]:
    queues: dict[str, list[ReadyScene]] = {}
    for scene in sorted(ready, key=lambda scene: (scene.left, scene.rank)):
        queues.setdefault(scene.pool, []).append(scene)
    return queues


def _take_batch(queue: list[ReadyScene], count: int) -> tuple[int, ...]:
    """Takes up to `count` scenes off the front; one that must be alone is alone."""
    end = 0
    while end < min(count, len(queue)) and not (queue[end].alone and end > 0):
        end += 1
        if queue[end - 1].alone:
            break
    taken, queue[:] = queue[:end], queue[end:]
    return tuple(scene.rank for scene in taken)
