"""Scheduling: sizes of the pools and assignment of scenes, as arithmetic over counts without clocks or Ray."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

TARGET_CALL_S = 0.5  # duration of a batch of scenes [s]: a call has an overhead of a millisecond
MAX_BATCH = 64
MIN_GAIN = 1.25  # pools are resized only for a throughput better by this factor: starting a worker is expensive


@dataclass(frozen=True, slots=True)
class PoolLimits:
    """Limits of one pool."""

    needs: Mapping[str, float]  # resources of one worker
    min_workers: int = 0  # workers that always run
    max_workers: int | None = None  # None for as many as fit
    batch: int = MAX_BATCH  # most scenes in one call
    recycle_after: int = 0  # scenes after which a worker is replaced; 0 for never

    def with_cap(self, cap: int | None) -> "PoolLimits":
        """Return the limits with at most `cap` workers, even below the minimum; None for no cap."""
        if cap is None:
            return self
        most = cap if self.max_workers is None else min(self.max_workers, cap)
        return replace(self, min_workers=min(self.min_workers, cap), max_workers=most)


@dataclass(frozen=True, slots=True)
class ScheduleLimits:
    """Limits of the schedule."""

    pools: Mapping[str, PoolLimits]
    capacity: Mapping[str, float]  # of each resource, for all pools together

    def fits(self, sizes: Mapping[str, int]) -> bool:
        """Whether pools of these sizes fit at once."""
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
    """A scene that waits for its next stages."""

    rank: int  # its rank in the plan
    pool: str  # of the workers that can run them
    left: int  # remaining stages, the next one included
    alone: bool = False  # whether it may not share a call, because it was in one whose worker was lost


def compute_min_sizes(limits: ScheduleLimits) -> dict[str, int]:
    """Compute the smallest sizes with which a build can end: one worker each, or the minimum."""
    return {name: max(1, pool.min_workers) for name, pool in limits.pools.items()}


def compute_pool_sizes(limits: ScheduleLimits, seconds: Mapping[str, float], now: Mapping[str, int]) -> dict[str, int]:
    """Compute the sizes of the pools for which the slowest pool is as fast as possible.

    Starting from the smallest sizes, which must fit, the pool that takes longest for a scene (`seconds`) gets one more
    worker until its resources are used up: more workers of another pool would not make the build faster. The sizes of
    `now` stay unless others are better by `MIN_GAIN`.
    """
    best = compute_min_sizes(limits)
    while True:
        slowest = max(sorted(best), key=lambda name: seconds[name] / best[name])
        grown = {**best, slowest: best[slowest] + 1}
        if seconds[slowest] <= 0.0 or not limits.fits(grown):
            break
        best = grown
    stays = now.keys() == best.keys() and all(now.values()) and limits.fits(now)
    if stays and compute_throughput(best, seconds) < MIN_GAIN * compute_throughput(now, seconds):
        return dict(now)
    return best


def compute_throughput(sizes: Mapping[str, int], seconds: Mapping[str, float]) -> float:
    """Compute the throughput of pools of these sizes, all of them busy [1/s]."""
    return min((size / seconds[name] for name, size in sizes.items() if seconds[name] > 0.0), default=math.inf)


def choose_batch_size(seconds: float | None, most: int) -> int:
    """Choose the scenes per call from the time of one scene [s]; one while it is unknown."""
    return 1 if seconds is None else max(1, min(most, int(TARGET_CALL_S / max(seconds, 1e-6))))


def compute_max_in_flight(sizes: Mapping[str, int], batches: Mapping[str, int]) -> int:
    """Compute the most scenes in flight, which bounds the memory: as many may wait as run."""
    return 2 * sum(size * batches[name] for name, size in sizes.items())


def assign_scenes(
    ready: Sequence[ReadyScene],
    idle: Mapping[str, Sequence[int]],
    placed: Mapping[str, int],
    sizes: Mapping[str, int],
    batches: Mapping[str, int],
) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Assign waiting scenes to idle workers: the worker of each call, and its ranks.

    In each pool those with the fewest stages left come first, in the plan's order. Together with the bounded number of
    scenes in flight this is the back-pressure: a pool whose successors are busy gets nothing to do. `placed` counts
    idle and busy workers, of which those beyond the target `sizes` get no work; `batches` are the most scenes per call.
    """
    chosen: list[tuple[int, tuple[int, ...]]] = []
    for pool, queue in sorted(_group_by_pool(ready).items()):
        workers = sorted(idle.get(pool, ()))
        fair = math.ceil(len(queue) / max(1, sizes[pool]))
        for worker in workers[: max(0, len(workers) - max(0, placed.get(pool, 0) - sizes[pool]))]:
            if not queue:
                break
            chosen.append((worker, _take_batch(queue, min(batches[pool], fair))))
    return tuple(chosen)


def scale_up(
    ready: Sequence[ReadyScene], idle: Mapping[str, Sequence[int]], alive: Mapping[str, int], sizes: Mapping[str, int]
) -> tuple[str, ...]:
    """Name a pool for each worker to start: scenes wait, and none is idle; starting ones are `alive`."""
    return tuple(
        pool
        for pool, queue in sorted(_group_by_pool(ready).items())
        if not idle.get(pool)
        for _ in range(min(len(queue), sizes[pool] - alive.get(pool, 0)))
    )


def scale_down(
    idle: Mapping[str, Sequence[int]], placed: Mapping[str, int], sizes: Mapping[str, int]
) -> tuple[int, ...]:
    """Select idle workers to retire from pools above `sizes`; starting ones are not `placed`: they may never fit."""
    return tuple(
        worker
        for pool, workers in sorted(idle.items())
        for worker in sorted(workers)[: max(0, placed.get(pool, 0) - sizes[pool])]
    )


def find_preemptible(
    ready: Sequence[ReadyScene], idle: Mapping[str, Sequence[int]], placed: Mapping[str, int], overdue: Collection[str]
) -> int | None:
    """Find an idle worker to retire because scenes wait for a pool whose workers cannot be placed; None for none.

    `ScheduleLimits` are sums over a cluster, and a worker must fit on one node: sizes that fit by sums may not fit.
    `placed` counts idle and busy workers; `overdue` are pools with a worker that has been starting for too long.
    """
    wanted = {scene.pool for scene in ready}
    if not any(pool in overdue and not placed.get(pool) for pool in wanted):
        return None
    spare = [pool for pool, workers in sorted(idle.items()) if workers and pool not in wanted]
    return min(idle[max(spare, key=lambda pool: len(idle[pool]))]) if spare else None


def _group_by_pool(ready: Sequence[ReadyScene]) -> dict[str, list[ReadyScene]]:
    queues: dict[str, list[ReadyScene]] = {}
    for scene in sorted(ready, key=lambda scene: (scene.left, scene.rank)):
        queues.setdefault(scene.pool, []).append(scene)
    return queues


def _take_batch(queue: list[ReadyScene], count: int) -> tuple[int, ...]:
    """Remove up to `count` scenes from the front; one that must be alone is alone."""
    end = 0
    while end < min(count, len(queue)) and not (queue[end].alone and end > 0):
        end += 1
        if queue[end - 1].alone:
            break
    taken, queue[:] = queue[:end], queue[end:]
    return tuple(scene.rank for scene in taken)
