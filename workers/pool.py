"""Pools of actors on Ray: one generic actor class, one call in flight per actor, nothing that Ray retries itself."""

import itertools
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
import ray.exceptions

from schemas.codec import decode, encode
from schemas.work import SandboxSetup, StageReport
from tableverse_factory.errors import BuildError
from tableverse_factory.stage import Pool
from workers.actor import StageActor
from workers.executor import Ended, Job, Payload, PayloadLostError
from workers.sandbox import START_S
from workers.wording import one_line

POOLS: tuple[str, ...] = get_args(Pool)
CPU_PER_ACTOR = 1.0 / len(POOLS)
"""As many calls run as there are workers, over all pools; so the actors of one worker share one CPU."""
OBJECT_STORE_BYTES = 1024**3
GRACE_S = 60.0
KNOCK_S = 10.0


@dataclass(frozen=True, slots=True)
class _Running:
    worker: int
    job: Job
    value: Any
    until: float


class RayExecutor:
    """Actors in four pools, made when they are first needed, replaced by the driver when they die."""

    def __init__(self, setup: SandboxSetup, workers: int | None, address: str | None) -> None:
        """Starts Ray on this machine, or joins the cluster at `address`.

        Raises:
            BuildError: if the cluster is not there, or has not what the pools ask for.
        """
        _connect(address)
        try:
            cluster = ray.cluster_resources()
            self._calls = workers or max(1, int(cluster.get("CPU", 1.0)))
            check_resources(self._calls, cluster)
        except BaseException:
            ray.shutdown()
            raise
        self._setup = encode(setup)
        self._call_s = START_S + setup.attempts * (setup.deadline_s + START_S) + GRACE_S
        options = {"num_cpus": CPU_PER_ACTOR, "max_restarts": 0, "max_task_retries": 0}
        self._actor_class: Any = ray.remote(**options)(StageActor)
        self._numbers = itertools.count()
        self._actors: dict[int, Any] = {}
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
        self._actors[number] = self._actor_class.options(name=f"{pool}-{number}").remote(self._setup)
        return number

    def submit(self, worker: int, job: Job) -> None:
        """Calls the actor; the call waits while the actor is still starting."""
        method = self._actors[worker].run.options(num_returns=2)
        report, value = method.remote(encode(job.call), job.payload)
        self._running[report] = _Running(worker, job, value, time.monotonic() + self._call_s)

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
        now = time.monotonic()
        silent = [reference for reference, running in self._running.items() if now > running.until]
        return ended + [self._give_up(reference, "no answer long after its deadline") for reference in silent]

    def fetch(self, payload: Payload) -> bytes:
        """Brings a record to this process.

        Raises:
            PayloadLostError: if the machine that held it is gone.
        """
        try:
            data: bytes = ray.get(payload)
        except ray.exceptions.RayError as error:
            raise PayloadLostError(_describe(error)) from error
        return data

    def close(self) -> None:
        """Kills the actors, whose children die with them, and leaves Ray."""
        for actor in self._actors.values():
            ray.kill(actor)
        ray.shutdown()

    def _collect(self, reference: Any) -> Ended:
        try:
            report: StageReport = decode(ray.get(reference))
        except BuildError as error:
            raise BuildError(str(getattr(error, "cause", error))) from None
        except ray.exceptions.ObjectLostError as error:
            return self._give_up(reference, _describe(error), input_lost=True)
        except ray.exceptions.RayError as error:
            return self._give_up(reference, _describe(error))
        running = self._running.pop(reference)
        return Ended(running.worker, running.job.rank, report, running.value)

    def _give_up(self, reference: Any, loss: str, input_lost: bool = False) -> Ended:
        """Forgets a worker, after making sure that it is dead: two at once would share one CPU and one scene."""
        running = self._running.pop(reference)
        ray.kill(self._actors.pop(running.worker))
        return Ended(running.worker, running.job.rank, None, loss=loss, input_lost=input_lost)


def check_resources(workers: int, cluster: Mapping[str, float]) -> None:
    """Refuses pools that the cluster could never hold: their actors would wait for ever.

    Raises:
        BuildError: saying what is asked for and what is there.
    """
    have = cluster.get("CPU", 0.0)
    if workers > have:
        raise BuildError(
            f"{workers} workers need {workers} CPUs and the cluster has {have:g}: give --workers {max(1, int(have))}"
        )


def _connect(address: str | None) -> None:
    if address not in (None, "auto"):
        _check_reachable(str(address))
    local: dict[str, Any] = {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
    try:
        ray.init(
            address=address or "local",
            configure_logging=True,
            logging_level="ERROR",
            log_to_driver=False,
            **({} if address else local),
        )
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        where = f"the Ray cluster at {address}" if address else "Ray on this machine"
        raise BuildError(f"{where} cannot be reached: {_describe(error)}") from error


def _check_reachable(address: str) -> None:
    """Knocks at the door first: `ray.init` waits for minutes, deaf to signals, where nobody answers."""
    host, _, port = address.rpartition(":")
    if "://" in address or not host or not port.isdecimal():
        raise BuildError(f"--address {address}: give auto, or HOST:PORT of the head node (the port is 6379 by default)")
    try:
        socket.create_connection((host, int(port)), timeout=KNOCK_S).close()
    except (OSError, OverflowError) as error:
        raise BuildError(f"the Ray cluster at {address} cannot be reached: {error}") from error


def _describe(error: Exception) -> str:
    return one_line(f"{type(error).__name__}: {error}")[:300]
