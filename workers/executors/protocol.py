"""Interface between the driver and executors; `local` and `ray` behave the same."""

from dataclasses import dataclass
from typing import Protocol

from schemas.work import CommitCall, StageChain, StageChainReport, StagedShard
from workers.executors.schedule import ScheduleLimits


@dataclass(frozen=True, slots=True)
class Job:
    """One scene's part of a call."""

    rank: int  # the scene's rank in the plan
    chain: StageChain


@dataclass(frozen=True, slots=True)
class JobResult:
    """Report of a job."""

    rank: int
    report: StageChainReport


@dataclass(frozen=True, slots=True)
class WorkerReady:
    """A worker has started and is idle."""

    worker: int


@dataclass(frozen=True, slots=True)
class CallFinished:
    """A call has ended."""

    worker: int
    answers: tuple[JobResult, ...]  # one for each of its jobs


@dataclass(frozen=True, slots=True)
class ShardStaged:
    """A worker has staged a shard for its commit."""

    worker: int
    call: CommitCall
    staged: StagedShard


@dataclass(frozen=True, slots=True)
class WorkerLost:
    """A worker is gone for good; the scenes of its call are not to blame."""

    worker: int
    work: tuple[Job, ...] | CommitCall  # of its call; no jobs if it never started
    why: str  # description of the loss
    raised: bool = False  # whether it raised an error of its own, most likely of its machine


Event = WorkerReady | CallFinished | ShardStaged | WorkerLost


class Executor(Protocol):
    """Workers in pools, one call in flight per worker."""

    @property
    def limits(self) -> ScheduleLimits:
        """Limits of the pools at present."""

    def pool_of(self, stage_pool: str) -> str:
        """Return the pool of workers for stages of the pool `stage_pool`."""

    def start(self, pool: str) -> int:
        """Request a worker; returns its number. `wait` reports its start, which may never come."""

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        """Send a call to an idle worker."""

    def stage_shard(self, worker: int, call: CommitCall) -> None:
        """Let an idle worker assemble a shard."""

    def wait(self, timeout_s: float) -> list[Event]:
        """Return the new events; wait for the first one at most `timeout_s`."""

    def retire(self, worker: int) -> None:
        """Stop an idle worker."""

    def close(self) -> None:
        """Stop all workers at once."""
