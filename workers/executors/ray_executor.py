"""Executor on Ray: pools of one generic actor class, one call in flight per actor, without Ray's own retries."""

import itertools
import math
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import ray
import ray.exceptions

from schemas.codec import decode, encode
from schemas.pools import Pools, PoolSpec
from schemas.work import CommitCall, SandboxSetup
from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.storage.files import StoragePath
from workers.executors.pool_capacity import check_pools, compute_pool_limits
from workers.executors.preflight import check_nodes, make_expectation
from workers.executors.protocol import (
    CallFinished,
    Event,
    Job,
    JobResult,
    ShardStaged,
    WorkerLost,
    WorkerReady,
)
from workers.executors.ray_actor import StageActor, WorkerError
from workers.executors.ray_cluster import check_workers, connect, describe_loss, list_alive_nodes, sum_capacity
from workers.executors.schedule import ScheduleLimits
from workers.sandbox.child import load_pipelines
from workers.sandbox.parent import START_TIMEOUT_S

CALL_GRACE_S = 60.0
REFRESH_S = 10.0  # interval between two checks of the nodes of a cluster [s]


@dataclass(frozen=True, slots=True)
class _Call:
    """A call in flight with its deadline `until` [s]."""

    worker: int
    work: tuple[Job, ...] | CommitCall
    until: float


@dataclass(frozen=True, slots=True)
class ClusterSpec:
    """The cluster, the part of it to use, and what its nodes must see."""

    address: str | None  # of a running cluster; None for one on this machine that ends with the build
    workers: int | None  # CPUs that the build may use; None for all
    inputs: Sequence[str]  # of the manifest
    shared: StoragePath  # a folder that all nodes must reach


class RayExecutor:
    """Executor of actors in pools; the driver starts and replaces them."""

    def __init__(self, setup: SandboxSetup, pools: Pools, cluster: ClusterSpec) -> None:
        """Start Ray on this machine, or join a cluster."""
        connect(cluster.address)
        try:
            pipelines = load_pipelines(setup.pipeline).values()
            self._pool_by_stage_pool = _group_pools(pools, {stage.pool for stages in pipelines for stage in stages})
            specs = {name: getattr(pools, name.partition("+")[0]) for name in self._pool_by_stage_pool.values()}
            self._specs, self._cluster = specs, cluster
            check_workers(cluster.workers, list_alive_nodes())
            self._limits = self._refresh_limits()
            check_pools(specs, list_alive_nodes(), self._limits.capacity, cluster.workers)
            self._expected = None
            if cluster.address is not None:
                nodes = list_alive_nodes()
                check_nodes(nodes, cluster.inputs, cluster.shared)
                self._expected = make_expectation(cluster.inputs, nodes)
        except BaseException:
            ray.shutdown()
            raise
        self._setup = encode(setup)
        self._attempts = setup.attempts
        self._classes = {name: _make_actor_class(spec) for name, spec in specs.items()}
        self._numbers = itertools.count()
        self._actors: dict[int, Any] = {}
        self._starting: dict[Any, int] = {}
        self._running: dict[Any, _Call] = {}

    @property
    def limits(self) -> ScheduleLimits:
        """Limits of the pools with the present nodes of the cluster."""
        if self._cluster.address is not None and time.monotonic() > self._refreshed_at + REFRESH_S:
            self._limits = self._refresh_limits()
        return self._limits

    def pool_of(self, stage_pool: str) -> str:
        """Return the stage's pool, or the one that it shares with pools of equal needs."""
        return self._pool_by_stage_pool[stage_pool]

    def start(self, pool: str) -> int:
        """Request an actor from Ray."""
        number = next(self._numbers)
        handle = self._classes[pool].options(name=f"{pool}-{number}").remote(self._setup)
        self._actors[number] = handle
        self._starting[handle.check.remote(self._expected)] = number
        return number

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        """Call the actor."""
        reference = self._actors[worker].run.remote(encode(tuple(job.chain for job in jobs)))
        self._running[reference] = _Call(worker, jobs, time.monotonic() + self._compute_deadline_s(jobs))

    def stage_shard(self, worker: int, call: CommitCall) -> None:
        """Call the actor; a store may be slow, so only its loss ends the call."""
        self._running[self._actors[worker].stage_shard.remote(encode(call))] = _Call(worker, call, math.inf)

    def wait(self, timeout_s: float) -> list[Event]:
        """Return started actors and finished calls; an actor that died or exceeds its deadline is killed."""
        awaited = [*self._running, *self._starting]
        if not awaited:
            return []
        ray.wait(awaited, timeout=timeout_s)
        ready, _ = ray.wait(awaited, num_returns=len(awaited), timeout=0)
        events = [
            self._on_actor_started(ref) if ref in self._starting else self._on_call_finished(ref) for ref in ready
        ]
        now = time.monotonic()
        late = [reference for reference, running in self._running.items() if now > running.until]
        return events + [self._drop_worker(reference, "no answer long after its deadline") for reference in late]

    def retire(self, worker: int) -> None:
        """Kill the actor; its child dies with it."""
        ray.kill(self._actors.pop(worker))

    def close(self) -> None:
        """Kill the actors, whose children die with them, and disconnect from Ray."""
        for actor in self._actors.values():
            ray.kill(actor)
        ray.shutdown()

    def _on_actor_started(self, reference: Any) -> Event:
        """Handle an actor that started, or died before."""
        worker = self._starting.pop(reference)
        try:
            problem = ray.get(reference)
        except ray.exceptions.RayError as error:
            ray.kill(self._actors.pop(worker))
            cause = getattr(error, "cause", None)
            return WorkerLost(worker, (), str(cause) if isinstance(cause, StoreError) else describe_loss(error))
        if problem:
            raise BuildError(problem)
        return WorkerReady(worker)

    def _refresh_limits(self) -> ScheduleLimits:
        """Compute the limits with the present nodes."""
        self._refreshed_at = time.monotonic()
        nodes, workers = list_alive_nodes(), self._cluster.workers
        pools = {name: compute_pool_limits(spec, nodes, workers) for name, spec in self._specs.items()}
        return ScheduleLimits(pools, sum_capacity(nodes, workers))

    def _compute_deadline_s(self, jobs: tuple[Job, ...]) -> float:
        """Compute the deadline of a call [s]: twice that of its longest scene, with all attempts and new sandboxes.

        Each stage may fail once more than it has attempts: in a used sandbox, where that does not count.
        Only scenes of negligible duration share a call; those of a failed call are called one by one.
        """
        longest = max(sum(call.deadline_s + START_TIMEOUT_S for call in job.chain.calls) for job in jobs)
        return START_TIMEOUT_S + CALL_GRACE_S + 2 * (self._attempts + 1) * longest

    def _on_call_finished(self, reference: Any) -> Event:
        try:
            data: bytes = ray.get(reference)
        except BuildError as error:
            raise BuildError(str(getattr(error, "cause", error))) from None
        except WorkerError as error:
            return self._drop_worker(reference, str(getattr(error, "cause", error)), raised=True)
        except ray.exceptions.RayError as error:
            return self._drop_worker(reference, describe_loss(error))
        running, answer = self._running.pop(reference), decode(data)
        if isinstance(running.work, CommitCall):
            return ShardStaged(running.worker, running.work, answer)
        results = zip(running.work, answer, strict=True)
        return CallFinished(running.worker, tuple(JobResult(job.rank, report) for job, report in results))

    def _drop_worker(self, reference: Any, why: str, *, raised: bool = False) -> WorkerLost:
        """Drop a worker after killing it: otherwise it could share a CPU and a scene with its successor."""
        running = self._running.pop(reference)
        ray.kill(self._actors.pop(running.worker))
        return WorkerLost(running.worker, running.work, why, raised)


def _group_pools(pools: Pools, used: Collection[str]) -> dict[str, str]:
    """Map each pool to its pool of actors: pools of equal needs share one, e.g. `geometry+physics`."""
    groups: dict[str, list[str]] = {}
    for name in (name for name in Pools.model_fields if name in used):
        groups.setdefault(getattr(pools, name).model_dump_json(), []).append(name)
    return {name: "+".join(members) for members in groups.values() for name in members}


def _make_actor_class(spec: PoolSpec) -> Any:
    memory = {"memory": spec.memory_mb * 1_000_000} if spec.memory_mb else {}
    return ray.remote(
        num_cpus=spec.cpus,
        num_gpus=spec.gpus,
        resources=dict(spec.resources),
        max_restarts=0,
        max_task_retries=0,
        **memory,
    )(StageActor)
