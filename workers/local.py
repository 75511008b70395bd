"""Everything in one sandbox below this process."""

from collections import deque
from collections.abc import Callable, Mapping

from schemas.work import SandboxSetup
from workers.executor import Ended, Job, Payload
from workers.sandbox import Sandbox

POOL = "local"


class LocalExecutor:
    """One worker for all pools; it works while `wait` waits."""

    def __init__(self, setup: SandboxSetup, watch: Callable[[], None]) -> None:
        """Prepares the sandbox; `watch` is called every few milliseconds and ends the work by raising."""
        self._sandbox = Sandbox(setup)
        self._watch = watch
        self._jobs: deque[tuple[int, Job]] = deque()

    @property
    def calls(self) -> int:
        """One."""
        return 1

    @property
    def pools(self) -> Mapping[str, int]:
        """One worker."""
        return {POOL: 1}

    def pool_of(self, stage_pool: str) -> str:  # noqa: ARG002 one sandbox runs all stages
        """The same for all stages."""
        return POOL

    def start(self, pool: str) -> int:  # noqa: ARG002 there is one pool
        """The sandbox starts its child with its first call."""
        return 0

    def submit(self, worker: int, job: Job) -> None:
        """Keeps the job for `wait`."""
        self._jobs.append((worker, job))

    def wait(self, timeout_s: float) -> list[Ended]:  # noqa: ARG002 there is always a job to run
        """Runs the job to its end."""
        if not self._jobs:
            return []
        worker, job = self._jobs.popleft()
        report, value = self._sandbox.run(job.call, job.payload, self._watch)
        return [Ended(worker, job.rank, report, value)]

    def fetch(self, payload: Payload) -> bytes:
        """They are here."""
        data: bytes = payload
        return data

    def close(self) -> None:
        """Kills the child."""
        self._sandbox.close()
