"""Pools of actors on Ray: one generic actor class, one call in flight per actor, nothing that Ray retries itself."""

import itertools
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import ray
import ray.exceptions

from schemas.codec import decode, encode
from schemas.pools import Pools, PoolSpec
from schemas.work import SandboxSetup, StageChainReport
from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.storage.files import StoragePath
from workers.executors.pool_capacity import check_pools, count_actors
from workers.executors.preflight import check_nodes, make_expectation
from workers.executors.protocol import (
    CallFinished,
    Event,
    Job,
    JobResult,
    Payload,
    PayloadLostError,
    WorkerLost,
    WorkerReady,
)
from workers.executors.ray_actor import StageActor
from workers.executors.ray_cluster import Node, check_workers, connect, describe_loss, list_alive_nodes, sum_capacity
from workers.executors.schedule import PoolLimits, ScheduleLimits
from workers.sandbox.child import load_pipelines
from workers.sandbox.parent import START_TIMEOUT_S

CALL_GRACE_S = 60.0
REFRESH_S = 10.0
"""Between two looks at the nodes of a cluster [s]."""


@dataclass(frozen=True, slots=True)
class _Call:
    """A call under way, whose time runs out at `until`."""

    worker: int
    jobs: tuple[Job, ...]
    values: list[Any]
    until: float

    @property
    def ranks(self) -> tuple[int, ...]:
        return tuple(job.rank for job in self.jobs)


@dataclass(frozen=True, slots=True)
class ClusterSpec:
    """Which cluster, how much of it, and what its nodes must see.

    Attributes:
        address: Of a running cluster; None for one on this machine that ends with the build.
        workers: CPUs that the build may use; None for all.
        inputs: What the manifest points at.
        shared: A folder that all nodes must reach.
    """

    address: str | None
    workers: int | None
    inputs: Sequence[str]
    shared: StoragePath


class RayExecutor:
    """Actors in pools, made when they are first needed, replaced by the driver when they die."""

    def __init__(self, setup: SandboxSetup, pools: Pools, where: ClusterSpec) -> None:
        """Starts Ray on this machine, or joins a cluster.

        Raises:
            BuildError: if the cluster is not there, has not what the pools ask for, or a node would give other bytes.
        """
        connect(where.address)
        try:
            lines = load_pipelines(setup.pipeline).values()
            self._shared = _group_pools(pools, {stage.pool for line in lines for stage in line})
            specs = {name: getattr(pools, name.partition("+")[0]) for name in self._shared.values()}
            self._specs, self._where = specs, where
            check_workers(where.workers, list_alive_nodes())
            self._limits = self._look()
            check_pools(specs, list_alive_nodes(), self._limits.capacity)
            self._expected = None
            if where.address is not None:
                nodes = list_alive_nodes()
                check_nodes(nodes, where.inputs, where.shared)
                self._expected = make_expectation(where.inputs, nodes)
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
        """What the pools ask for, and what the cluster has now: nodes come and go."""
        if self._where.address is not None and time.monotonic() > self._looked + REFRESH_S:
            self._limits = self._look()
        return self._limits

    def pool_of(self, stage_pool: str) -> str:
        """The stage's own, or the one that it shares with others which ask for the same."""
        return self._shared[stage_pool]

    def start(self, pool: str) -> int:
        """Asks Ray for an actor."""
        number = next(self._numbers)
        handle = self._classes[pool].options(name=f"{pool}-{number}").remote(self._setup)
        self._actors[number] = handle
        self._starting[handle.check.remote(self._expected)] = number
        return number

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        """Calls the actor."""
        method = self._actors[worker].run.options(num_returns=1 + len(jobs))
        report, *values = method.remote(encode(tuple(job.chain for job in jobs)), *(job.payload for job in jobs))
        self._running[report] = _Call(worker, jobs, values, time.monotonic() + self._longest(jobs))

    def wait(self, timeout_s: float) -> list[Event]:
        """Actors that came, and calls that ended; an actor that died or stays silent is killed and forgotten.

        Raises:
            BuildError: if an actor says that it can never work.
        """
        awaited = [*self._running, *self._starting]
        if not awaited:
            return []
        ray.wait(awaited, timeout=timeout_s)
        ready, _ = ray.wait(awaited, num_returns=len(awaited), timeout=0)
        events = [self._greet(ref) if ref in self._starting else self._collect(ref) for ref in ready]
        now = time.monotonic()
        silent = [reference for reference, running in self._running.items() if now > running.until]
        return events + [self._give_up(reference, "no answer long after its deadline") for reference in silent]

    def retire(self, worker: int) -> None:
        """Kills the actor; its child dies with it."""
        ray.kill(self._actors.pop(worker))

    def fetch(self, payload: Payload) -> bytes:
        """Brings a record to this process.

        Raises:
            PayloadLostError: if the machine that held it is gone.
        """
        try:
            data: bytes = ray.get(payload)
        except ray.exceptions.RayError as error:
            raise PayloadLostError(describe_loss(error)) from error
        return data

    def close(self) -> None:
        """Kills the actors, whose children die with them, and leaves Ray."""
        for actor in self._actors.values():
            ray.kill(actor)
        ray.shutdown()

    def _greet(self, reference: Any) -> Event:
        """An actor is there, or died on its way.

        Raises:
            BuildError: if it is on a node that would give other bytes.
        """
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

    def _look(self) -> ScheduleLimits:
        """The limits with the nodes that are there now."""
        self._looked = time.monotonic()
        nodes = list_alive_nodes()
        pools = {name: _compute_pool_limits(spec, nodes) for name, spec in self._specs.items()}
        return ScheduleLimits(pools, sum_capacity(nodes, self._where.workers))

    def _longest(self, jobs: tuple[Job, ...]) -> float:
        """How long a call may take: twice what its longest scene may, all attempts and new sandboxes included [s].

        Only scenes that take next to nothing share a call; those of a call that is given up are called one by one.
        """
        longest = max(sum(call.deadline_s + START_TIMEOUT_S for call in job.chain.calls) for job in jobs)
        return START_TIMEOUT_S + CALL_GRACE_S + 2 * self._attempts * longest

    def _collect(self, reference: Any) -> Event:
        try:
            reports: tuple[StageChainReport, ...] = decode(ray.get(reference))
        except BuildError as error:
            raise BuildError(str(getattr(error, "cause", error))) from None
        except ray.exceptions.ObjectLostError as error:
            return self._give_up(reference, describe_loss(error), inputs_lost=True)
        except ray.exceptions.RayError as error:
            return self._give_up(reference, describe_loss(error))
        running = self._running.pop(reference)
        ended = zip(running.ranks, reports, running.values, strict=True)
        return CallFinished(running.worker, tuple(JobResult(rank, report, value) for rank, report, value in ended))

    def _give_up(self, reference: Any, loss: str, inputs_lost: bool = False) -> WorkerLost:
        """Forgets a worker, after making sure that it is dead: two at once would share one CPU and one scene."""
        running = self._running.pop(reference)
        ray.kill(self._actors.pop(running.worker))
        return WorkerLost(running.worker, running.ranks, loss, inputs_lost)


def _group_pools(pools: Pools, used: Collection[str]) -> dict[str, str]:
    """The pool of actors that runs the stages of each pool: those that ask for the same are one, `geometry+physics`."""
    groups: dict[str, list[str]] = {}
    for name in (name for name in Pools.model_fields if name in used):
        groups.setdefault(getattr(pools, name).model_dump_json(), []).append(name)
    return {name: "+".join(members) for members in groups.values() for name in members}


def _compute_pool_limits(spec: PoolSpec, nodes: Sequence[Node]) -> PoolLimits:
    needs = spec.needs()
    room = sum(count_actors(node.resources, needs) for node in nodes)
    return PoolLimits(needs, spec.min, min(room, spec.max or room), recycle_after=spec.recycle_after)


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
