"""The workers of a build as the driver knows them: who is idle, how fast each pool is, who comes and who goes."""

from collections import Counter
from collections.abc import Callable, Sequence

from workers.executor import Ended, Event, Executor, Job, Lost, Started
from workers.schedule import Limits, Ready, assign, batch_size, line_length, recruits, sizes_for, surplus

RESIZE_AFTER = 20
"""Calls between two looks at the sizes of the pools."""
_MEMORY = 0.05
"""Weight of the newest scene in the mean time of its pool."""


class Crew:
    """Assigns calls to workers, starts and retires them, and learns how long scenes take.

    Attributes:
        restarts: Workers that were started in the place of one that was lost or at the end of its time.
    """

    def __init__(self, executor: Executor, pools: Sequence[str]) -> None:
        """Starts the workers that are always there.

        Args:
            executor: Where they work.
            pools: Those that the build needs.
        """
        self._executor = executor
        self._names = pools
        self._seconds: dict[str, float] = {}
        self._sizes = self._best({})
        self._pool: dict[int, str] = {}
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
        """Workers of each pool, idle or busy."""
        return Counter(self._pool.values())

    @property
    def line(self) -> int:
        """Scenes inside the line at most."""
        return line_length(self._sizes, self._batches())

    @property
    def most_calls(self) -> int:
        """Calls that can be in flight at once."""
        return sum(self._sizes.values())

    def hand_out(self, ready: Sequence[Ready], job_of: Callable[[int], Job]) -> tuple[int, ...]:
        """Gives idle workers what waits, asks for more of them, and lets go those that are too many.

        Returns:
            Ranks of the scenes that run now.
        """
        for worker in surplus(self._idle_by_pool(), self.alive, self._sizes):
            self._retire(worker)
        idle = self._idle_by_pool()
        for pool in recruits(ready, idle, self.alive, self._sizes):
            self._start(pool)
        chosen = assign(ready, idle, self.alive, self._sizes, self._batches())
        for choice in chosen:
            self._idle.discard(choice.worker)
            self._executor.submit(choice.worker, tuple(job_of(rank) for rank in choice.ranks))
        return tuple(rank for choice in chosen for rank in choice.ranks)

    def hear(self, event: Event) -> None:
        """A worker came, went, or is idle again, or at the end of its time."""
        match event:
            case Started(worker=worker):
                self._idle.add(worker)
            case Lost(worker=worker):
                self._gone[self._pool[worker]] += 1
                self._forget(worker)
            case Ended():
                self._learn(event)

    def _learn(self, ended: Ended) -> None:
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
        if self._until_resize <= 0:
            self._until_resize, self._sizes = RESIZE_AFTER, self._best(self._sizes)

    @property
    def _limits(self) -> Limits:
        """Of the pools that the build needs; nodes come and go."""
        limits = self._executor.limits
        return Limits({name: limits.pools[name] for name in self._names}, limits.capacity)

    def _best(self, now: dict[str, int]) -> dict[str, int]:
        """The pools' best sizes; of what is not known yet, as if all pools were equally fast."""
        return sizes_for(self._limits, {name: self._seconds.get(name, 1.0) for name in self._limits.pools}, now)

    def _batches(self) -> dict[str, int]:
        return {name: batch_size(self._seconds.get(name), pool.batch) for name, pool in self._limits.pools.items()}

    def _idle_by_pool(self) -> dict[str, list[int]]:
        idle: dict[str, list[int]] = {}
        for worker in self._idle:
            idle.setdefault(self._pool[worker], []).append(worker)
        return idle

    def _start(self, pool: str) -> None:
        self._pool[self._executor.start(pool)] = pool
        if self._gone[pool]:
            self._gone[pool] -= 1
            self.restarts += 1

    def _retire(self, worker: int) -> None:
        self._executor.retire(worker)
        self._forget(worker)

    def _forget(self, worker: int) -> None:
        self._idle.discard(worker)
        del self._pool[worker]
        self._served.pop(worker, None)
