"""Executor without Ray: one sandbox below this process."""

from collections.abc import Callable

from schemas.work import SandboxSetup
from workers.executors.protocol import CallFinished, Event, Job, JobResult, Payload, WorkerReady
from workers.executors.schedule import PoolLimits, ScheduleLimits
from workers.sandbox.parent import Sandbox

POOL = "local"


class LocalExecutor:
    """One worker for all pools; it runs inside `wait`."""

    def __init__(self, setup: SandboxSetup, watch: Callable[[], None]) -> None:
        """Create the sandbox; `watch` is called every few milliseconds and ends the call by raising."""
        self._sandbox = Sandbox(setup)
        self._watch = watch
        self._starting = False
        self._call: tuple[int, tuple[Job, ...]] | None = None

    @property
    def limits(self) -> ScheduleLimits:
        """One worker."""
        return ScheduleLimits({POOL: PoolLimits({"CPU": 1.0}, batch=1)}, {"CPU": 1.0})

    def pool_of(self, stage_pool: str) -> str:  # noqa: ARG002 one sandbox runs all stages
        """Return the one pool."""
        return POOL

    def start(self, pool: str) -> int:  # noqa: ARG002 there is one pool
        """Announce the worker; the sandbox starts its child with its first call."""
        self._starting = True
        return 0

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        """Keep the call for `wait`."""
        self._call = worker, jobs

    def wait(self, timeout_s: float) -> list[Event]:  # noqa: ARG002 a call runs to its end
        """Run the call to its end."""
        if self._call is None:
            started, self._starting = self._starting, False
            return [WorkerReady(0)] if started else []
        (worker, jobs), self._call = self._call, None
        answers = []
        for job in jobs:
            report, value = self._sandbox.run(job.chain, job.payload, self._watch)
            answers.append(JobResult(job.rank, report, value))
        return [CallFinished(worker, tuple(answers))]

    def retire(self, worker: int) -> None:  # noqa: ARG002 there is one
        """Kill the child; the next call starts another."""
        self._sandbox.close()

    def fetch(self, payload: Payload) -> bytes:
        """Return the payload, which is bytes already."""
        return payload

    def close(self) -> None:
        """Kill the child."""
        self._sandbox.close()
