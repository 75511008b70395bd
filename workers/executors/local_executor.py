"""Executor without Ray: one sandbox below this process."""

from collections.abc import Callable

from schemas.work import CommitCall, SandboxSetup
from tableverse_factory.core.storage.files import parse_path
from workers.executors.protocol import CallFinished, Event, Job, JobResult, ShardStaged, WorkerReady
from workers.executors.schedule import PoolLimits, ScheduleLimits
from workers.sandbox.parent import Sandbox
from workers.state.commit import stage_shard

POOL = "local"


class LocalExecutor:
    """One worker for all pools; it runs inside `wait`."""

    def __init__(self, setup: SandboxSetup, watch: Callable[[], None]) -> None:
        """Create the sandbox; `watch` is called every few milliseconds and ends the call by raising."""
        self._sandbox = Sandbox(setup)
        self._out = parse_path(setup.records_dir).parent
        self._watch = watch
        self._starting = False
        self._work: tuple[Job, ...] | CommitCall = ()

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

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:  # noqa: ARG002 there is one
        """Keep the call for `wait`."""
        self._work = jobs

    def stage_shard(self, worker: int, call: CommitCall) -> None:  # noqa: ARG002 there is one
        """Keep the call for `wait`."""
        self._work = call

    def wait(self, timeout_s: float) -> list[Event]:  # noqa: ARG002 a call runs to its end
        """Run the call to its end."""
        work, self._work = self._work, ()
        if isinstance(work, CommitCall):
            return [ShardStaged(0, work, stage_shard(self._out, work))]
        if work:
            results = (JobResult(job.rank, self._sandbox.run(job.chain, self._watch)) for job in work)
            return [CallFinished(0, tuple(results))]
        started, self._starting = self._starting, False
        return [WorkerReady(0)] if started else []

    def retire(self, worker: int) -> None:  # noqa: ARG002 there is one
        """Kill the child; the next call starts another."""
        self._sandbox.close()

    def close(self) -> None:
        """Kill the child."""
        self._sandbox.close()
