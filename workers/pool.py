"""Pools of actors on Ray: one generic actor class, one call in flight per actor, nothing that Ray retries itself."""

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import ray
import ray.exceptions

from schemas.codec import decode, encode
from schemas.work import SandboxSetup, StageReport
from tableverse_factory.errors import BuildError
from tableverse_factory.stage import Pool
from workers.actor import StageActor
from workers.cluster import alive_nodes, check_resources, connect, describe_loss
from workers.executor import Ended, Job, Payload, PayloadLostError
from workers.preflight import check_nodes
from workers.sandbox import START_S

POOLS: tuple[str, ...] = get_args(Pool)
CPU_PER_ACTOR = 1.0 / len(POOLS)
"""As many calls run as there are workers, over all pools; so the actors of one worker share one CPU."""
GRACE_S = 60.0


@dataclass(slots=True)
class _Actor:
    """One actor; `starting` is answered when it is there, and None from then on."""

    handle: Any
    starting: Any


@dataclass(slots=True)
class _Running:
    """A call under way; its time runs out at `until`, which is set when its actor is there."""

    worker: int
    job: Job
    value: Any
    until: float = math.inf


class RayExecutor:
    """Actors in four pools, made when they are first needed, replaced by the driver when they die."""

    def __init__(self, setup: SandboxSetup, workers: int | None, address: str | None, inputs: Sequence[str]) -> None:
        """Starts Ray on this machine, or joins the cluster at `address`, whose nodes must see the `inputs`.

        Raises:
            BuildError: if the cluster is not there, has not what the pools ask for, or a node would give other bytes.
        """
        connect(address)
        try:
            cluster = ray.cluster_resources()
            self._calls = workers or max(1, int(cluster.get("CPU", 1.0)))
            check_resources(self._calls, cluster)
            if address is not None:
                check_nodes(alive_nodes(), inputs, shared=None)
        except BaseException:
            ray.shutdown()
            raise
        self._setup = encode(setup)
        self._call_s = START_S + setup.attempts * (setup.deadline_s + START_S) + GRACE_S
        options = {"num_cpus": CPU_PER_ACTOR, "max_restarts": 0, "max_task_retries": 0}
        self._actor_class: Any = ray.remote(**options)(StageActor)
        self._numbers = itertools.count()
        self._actors: dict[int, _Actor] = {}
        self._running: dict[Any, _Running] = {}

    @property
    def calls(self) -> int:
        """As many as there are workers."""
        return self._calls

    @property
    def pools(self) -> Mapping[str, int]:
        """As many actors in each pool as calls may be in flight."""
        return dict.fromkeys(POOLS, self._calls)

    def pool_of(self, stage_pool: str) -> str:
        """The stage's own."""
        return stage_pool

    def start(self, pool: str) -> int:
        """Asks Ray for an actor."""
        number = next(self._numbers)
        handle = self._actor_class.options(name=f"{pool}-{number}").remote(self._setup)
        self._actors[number] = _Actor(handle, handle.__ray_ready__.remote())
        return number

    def submit(self, worker: int, job: Job) -> None:
        """Calls the actor; the call waits while the actor is still starting."""
        method = self._actors[worker].handle.run.options(num_returns=2)
        report, value = method.remote(encode(job.call), job.payload)
        self._running[report] = _Running(worker, job, value)

    def wait(self, timeout_s: float) -> list[Ended]:
        """Reports of the calls that ended; an actor that died or stays silent is killed and forgotten.

        Raises:
            BuildError: if an actor says that it can never work.
        """
        if not self._running:
            return []
        ray.wait(list(self._running), timeout=timeout_s)
        ready, _ = ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        ended = [self._collect(reference) for reference in ready]
        return ended + [self._give_up(reference, "no answer long after its deadline") for reference in self._silent()]

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
            ray.kill(actor.handle)
        ray.shutdown()

    def _silent(self) -> list[Any]:
        """Calls without an answer long after their deadline; waiting for an actor to be placed does not count."""
        now = time.monotonic()
        for running in self._running.values():
            actor = self._actors[running.worker]
            if actor.starting is not None and ray.wait([actor.starting], timeout=0)[0]:
                actor.starting = None
            if actor.starting is None:
                running.until = min(running.until, now + self._call_s)
        return [reference for reference, running in self._running.items() if now > running.until]

    def _collect(self, reference: Any) -> Ended:
        try:
            report: StageReport = decode(ray.get(reference))
        except BuildError as error:
            raise BuildError(str(getattr(error, "cause", error))) from None
        except ray.exceptions.ObjectLostError as error:
            return self._give_up(reference, describe_loss(error), input_lost=True)
        except ray.exceptions.RayError as error:
            return self._give_up(reference, describe_loss(error))
        running = self._running.pop(reference)
        return Ended(running.worker, running.job.rank, report, running.value)

    def _give_up(self, reference: Any, loss: str, input_lost: bool = False) -> Ended:
        """Forgets a worker, after making sure that it is dead: two at once would share one CPU and one scene."""
        running = self._running.pop(reference)
        ray.kill(self._actors.pop(running.worker).handle)
        return Ended(running.worker, running.job.rank, None, loss=loss, input_lost=input_lost)
