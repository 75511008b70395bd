"""The workers of a build as the driver knows them: who is idle, how fast each pool is, who comes and who goes."""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence

from workers.executors.protocol import CallFinished, Event, Executor, Job, WorkerLost, WorkerReady
from workers.executors.schedule import (
    Ready,
    ScheduleLimits,
    assign,
    batch_size,
    find_preemptible,
    max_in_flight,
    scale_down,
    scale_up,
    sizes_for,
)

RESIZE_AFTER = 20
"""Calls between two looks at the sizes of the pools."""
PATIENCE_S = 20.0
"""A worker starts within seconds; one that takes longer finds no place on any node [s]."""
_MEMORY = 0.05
"""Weight of the newest scene in the mean time of its pool."""


class WorkerManager:
    """Assigns calls to workers, starts and retires them, and learns how long scenes take.

    Attributes:
        restarts: Workers that were started in the place of one that was lost or at the end of its time.
    """

    def __init__(self, executor: Executor, pools: Sequence[str], clock: Callable[[], float] = time.monotonic) -> None:
        """Starts the workers that are always there.

        Args:
            executor: Where they work.
            pools: Those that the build needs.
            clock: Any that never goes back [s].
        """
        self._executor = executor
        self._names = pools
        self._clock = clock
        self._let_go_at = -math.inf
        self._caps: dict[str, int] = {}
        self._known_limits = executor.limits
        self._seconds: dict[str, float] = {}
        self._sizes = self._best({})
        self._pool: dict[int, str] = {}
        self._starting: dict[int, float] = {}
        self._idle: set[int] = set()
        self._served: Counter[int] = Counter()
        self._until_resize = RESIZE_AFTER
        self.restarts = 0
        self._gone: Counter[str] = Counter()
        for name, pool in self._limits.pools.items():
            for _ in range(pool.least):
                self._start(name)

    @property
    def sizes(self) -> dict[str, int]:
        """Workers that each pool should have."""
        return self._sizes

    @property
    def alive(self) -> Counter[str]:
        """Workers of each pool, idle, busy or starting."""
        return Counter(self._pool.values())

    @property
    def line(self) -> int:
        """Scenes inside the line at most."""
        return max_in_flight(self._sizes, self._batches())

    @property
    def most_calls(self) -> int:
        """Calls that can be in flight at once."""
        return sum(self._sizes.values())

    def hand_out(self, ready: Sequence[Ready], job_of: Callable[[int], Job]) -> tuple[int, ...]:
        """Gives idle workers what waits, asks for more of them, and lets go those that are too many.

        Returns:
            Ranks of the scenes that run now.
        """
        self._resize()
        self._make_way(ready)
        for worker in scale_down(self._idle_by_pool(), self._there(), self._sizes):
            self._retire(worker)
        idle = self._idle_by_pool()
        for pool in scale_up(ready, idle, self.alive, self._sizes):
            self._start(pool)
        chosen = assign(ready, idle, self._there(), self._sizes, self._batches())
        for choice in chosen:
            self._idle.discard(choice.worker)
            self._executor.submit(choice.worker, tuple(job_of(rank) for rank in choice.ranks))
        return tuple(rank for choice in chosen for rank in choice.ranks)

    def hear(self, event: Event) -> None:
        """A worker came, went, or is idle again, or at the end of its time."""
        match event:
            case WorkerReady(worker=worker):
                del self._starting[worker]
                self._idle.add(worker)
            case WorkerLost(worker=worker):
                self._gone[self._pool[worker]] += 1
                self._forget(worker)
                self._until_resize = 0
            case CallFinished():
                self._learn(event)

    def _learn(self, ended: CallFinished) -> None:
        pool = self._pool[ended.worker]
        for answer in ended.answers:
            took = sum(report.wall_s for report in answer.report.stages)
            known = self._seconds.setdefault(pool, took)
            self._seconds[pool] = known + _MEMORY * (took - known)
        self._idle.add(ended.worker)
        self._served[ended.worker] += len(ended.answers)
        if 0 < self._limits.pools[pool].recycle_after <= self._served[ended.worker]:
            self._gone[pool] += 1
            self._retire(ended.worker)
        self._until_resize -= 1

    def _resize(self) -> None:
        """Looks at the sizes now and then, and at once where nodes came or went: then no cap is known to hold."""
        limits = self._executor.limits
        if limits != self._known_limits:
            self._known_limits, self._until_resize = limits, 0
            self._caps.clear()
        if self._until_resize <= 0:
            self._until_resize, self._sizes = RESIZE_AFTER, self._best(self._sizes)

    def _make_way(self, ready: Sequence[Ready]) -> None:
        """Lets an idle worker go where that of another pool finds no place, and caps its pool so that it stays away."""
        now = self._clock()
        overdue = {
            self._pool[worker]
            for worker, since in self._starting.items()
            if now - max(since, self._let_go_at) > PATIENCE_S
        }
        worker = find_preemptible(ready, self._idle_by_pool(), self._there(), overdue)
        if worker is not None:
            pool, self._let_go_at = self._pool[worker], now
            self._retire(worker)
            self._caps[pool] = max(1, self.alive[pool])
            self._sizes = self._best(self._sizes)

    @property
    def _limits(self) -> ScheduleLimits:
        """Of the pools that the build needs, as far as they are known to find places."""
        limits = self._executor.limits
        return ScheduleLimits(
            {name: limits.pools[name].capped(self._caps.get(name)) for name in self._names}, limits.capacity
        )

    def _best(self, now: dict[str, int]) -> dict[str, int]:
        """The pools' best sizes; of what is not known yet, as if all pools were equally fast."""
        return sizes_for(self._limits, {name: self._seconds.get(name, 1.0) for name in self._limits.pools}, now)

    def _batches(self) -> dict[str, int]:
        return {name: batch_size(self._seconds.get(name), pool.batch) for name, pool in self._limits.pools.items()}

    def _there(self) -> Counter[str]:
        """Workers of each pool, idle or busy."""
        return Counter(pool for worker, pool in self._pool.items() if worker not in self._starting)

    def _idle_by_pool(self) -> dict[str, list[int]]:
        idle: dict[str, list[int]] = {}
        for worker in self._idle:
            idle.setdefault(self._pool[worker], []).append(worker)
        return idle

    def _start(self, pool: str) -> None:
        worker = self._executor.start(pool)
        self._pool[worker], self._starting[worker] = pool, self._clock()
        if self._gone[pool]:
            self._gone[pool] -= 1
            self.restarts += 1

    def _retire(self, worker: int) -> None:
        self._executor.retire(worker)
        self._forget(worker)

    def _forget(self, worker: int) -> None:
        self._idle.discard(worker)
        self._starting.pop(worker, None)
        del self._pool[worker]
        self._served.pop(worker, None)
