"""Worker pools of a build: dispatch of scenes, sizes of the pools, starts and retirements."""

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence

from schemas.work import CommitCall
from workers.executors.protocol import CallFinished, Event, Executor, Job, ShardStaged, WorkerLost, WorkerReady
from workers.executors.schedule import (
    ReadyScene,
    ScheduleLimits,
    assign_scenes,
    choose_batch_size,
    compute_max_in_flight,
    compute_pool_sizes,
    find_preemptible,
    scale_down,
    scale_up,
)

RESIZE_INTERVAL = 20  # calls between two checks of the sizes of the pools
PLACEMENT_TIMEOUT_S = 20.0  # A worker that takes longer to start fits on no node [s]
_SMOOTHING = 0.05  # weight of the newest scene in the moving average of its pool's scene time


class WorkerManager:
    """Manager of the workers of all pools."""

    def __init__(self, executor: Executor, pools: Sequence[str], clock: Callable[[], float] = time.monotonic) -> None:
        """Start the minimum of workers of the pools that the build needs; `clock` is monotonic [s]."""
        self._executor = executor
        self._names = pools
        self._clock = clock
        self._preempted_at = -math.inf
        self._caps: dict[str, int] = {}
        self._known_limits = executor.limits
        self._seconds: dict[str, float] = {}
        self.sizes = self._compute_sizes({})  # targets
        self._pool: dict[int, str] = {}
        self._starting: dict[int, float] = {}
        self._idle: set[int] = set()
        self._served: Counter[int] = Counter()
        self._until_resize = RESIZE_INTERVAL
        self.restarts = 0  # workers started in place of a lost or recycled one
        self._departed: Counter[str] = Counter()
        for name, pool in self._limits.pools.items():
            for _ in range(pool.min_workers):
                self._start(name)

    @property
    def alive(self) -> Counter[str]:
        """Idle, busy and starting workers of each pool."""
        return Counter(self._pool.values())

    @property
    def max_in_flight(self) -> int:
        """Most scenes between their first and last stage."""
        return compute_max_in_flight(self.sizes, self._choose_batch_sizes())

    @property
    def max_calls_in_flight(self) -> int:
        """Most calls in flight at once."""
        return sum(self.sizes.values())

    def dispatch(self, ready: Sequence[ReadyScene], make_job: Callable[[int], Job]) -> tuple[int, ...]:
        """Send waiting scenes to idle workers, and start or retire workers; returns the ranks that were sent."""
        self._resize()
        self._preempt(ready)
        for worker in scale_down(self._group_idle(), self._count_placed(), self.sizes):
            self._retire(worker)
        idle = self._group_idle()
        for pool in scale_up(ready, idle, self.alive, self.sizes):
            self._start(pool)
        chosen = assign_scenes(ready, idle, self._count_placed(), self.sizes, self._choose_batch_sizes())
        for worker, ranks in chosen:
            self._idle.discard(worker)
            self._executor.submit(worker, tuple(make_job(rank) for rank in ranks))
        return tuple(rank for _, ranks in chosen for rank in ranks)

    def dispatch_commits(self, calls: list[CommitCall]) -> None:
        """Let idle workers assemble shards, and take these calls off the list; if there is no worker, start one."""
        if calls and not self._pool:
            self._start(self._names[0])
        while calls and self._idle:
            worker = min(self._idle)
            self._idle.discard(worker)
            self._executor.stage_shard(worker, calls.pop(0))

    def on_event(self, event: Event) -> None:
        """Update the pools after an event of the executor."""
        match event:
            case WorkerReady(worker=worker):
                del self._starting[worker]
                self._idle.add(worker)
            case WorkerLost(worker=worker):
                self._departed[self._pool[worker]] += 1
                self._forget(worker)
                self._until_resize = 0
            case ShardStaged(worker=worker):
                self._idle.add(worker)
            case CallFinished():
                self._record_call(event)

    def _record_call(self, call: CallFinished) -> None:
        pool = self._pool[call.worker]
        for answer in call.answers:
            scene_s = sum(report.wall_s for report in answer.report.stages)
            mean_s = self._seconds.setdefault(pool, scene_s)
            self._seconds[pool] = mean_s + _SMOOTHING * (scene_s - mean_s)
        self._idle.add(call.worker)
        self._served[call.worker] += len(call.answers)
        if 0 < self._limits.pools[pool].recycle_after <= self._served[call.worker]:
            self._departed[pool] += 1
            self._retire(call.worker)
        self._until_resize -= 1

    def _resize(self) -> None:
        """Recompute the sizes now and then, and at once when nodes came or went, which voids the caps."""
        limits = self._executor.limits
        if limits != self._known_limits:
            self._known_limits, self._until_resize = limits, 0
            self._caps.clear()
        if self._until_resize <= 0:
            self._until_resize, self.sizes = RESIZE_INTERVAL, self._compute_sizes(self.sizes)

    def _preempt(self, ready: Sequence[ReadyScene]) -> None:
        """Retire an idle worker if one of another pool cannot be placed, and cap its pool so that it stays away."""
        now = self._clock()
        overdue = {
            self._pool[worker]
            for worker, since in self._starting.items()
            if now - max(since, self._preempted_at) > PLACEMENT_TIMEOUT_S
        }
        worker = find_preemptible(ready, self._group_idle(), self._count_placed(), overdue)
        if worker is not None:
            pool, self._preempted_at = self._pool[worker], now
            self._retire(worker)
            self._caps[pool] = max(1, self.alive[pool])
            self.sizes = self._compute_sizes(self.sizes)

    @property
    def _limits(self) -> ScheduleLimits:
        """Limits of the needed pools, with the caps of those that could not be placed."""
        limits = self._executor.limits
        return ScheduleLimits(
            {name: limits.pools[name].with_cap(self._caps.get(name)) for name in self._names}, limits.capacity
        )

    def _compute_sizes(self, now: dict[str, int]) -> dict[str, int]:
        """Compute the best sizes; pools without timings count as equally fast."""
        seconds = {name: self._seconds.get(name, 1.0) for name in self._limits.pools}
        return compute_pool_sizes(self._limits, seconds, now)

    def _choose_batch_sizes(self) -> dict[str, int]:
        pools = self._limits.pools
        return {name: choose_batch_size(self._seconds.get(name), pool.batch) for name, pool in pools.items()}

    def _count_placed(self) -> Counter[str]:
        return Counter(pool for worker, pool in self._pool.items() if worker not in self._starting)

    def _group_idle(self) -> dict[str, list[int]]:
        idle: dict[str, list[int]] = {}
        for worker in self._idle:
            idle.setdefault(self._pool[worker], []).append(worker)
        return idle

    def _start(self, pool: str) -> None:
        worker = self._executor.start(pool)
        self._pool[worker], self._starting[worker] = pool, self._clock()
        if self._departed[pool]:
            self._departed[pool] -= 1
            self.restarts += 1

    def _retire(self, worker: int) -> None:
        self._executor.retire(worker)
        self._forget(worker)

    def _forget(self, worker: int) -> None:
        self._idle.discard(worker)
        self._starting.pop(worker, None)
        del self._pool[worker]
        self._served.pop(worker, None)
