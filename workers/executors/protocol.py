"""Interface between the driver and executors; `local` and `ray` behave the same."""

from dataclasses import dataclass
from typing import Any, Protocol

from schemas.work import StageChain, StageChainReport
from workers.executors.schedule import ScheduleLimits

Payload = Any  # an encoded record: bytes in this process, or a reference into Ray's object store


@dataclass(frozen=True, slots=True)
class Job:
    """One scene's part of a call."""

    rank: int  # the scene's rank in the plan
    chain: StageChain
    payload: Payload  # their input; empty if the chain names a checkpoint


@dataclass(frozen=True, slots=True)
class JobResult:
    """Report of a job, and the next record if all of its stages are done."""

    rank: int
    report: StageChainReport
    payload: Payload


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
class WorkerLost:
    """A worker is gone for good; the scenes of its call are not to blame."""

    worker: int
    ranks: tuple[int, ...]  # the scenes of its call; none if it never started
    why: str  # description of the loss
    inputs_lost: bool = False  # whether inputs of the call are gone, too


Event = WorkerReady | CallFinished | WorkerLost


class PayloadLostError(Exception):
    """A record was on a lost machine."""


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

    def wait(self, timeout_s: float) -> list[Event]:
        """Return the new events; wait for the first one at most `timeout_s`."""

    def retire(self, worker: int) -> None:
        """Stop an idle worker."""

    def fetch(self, payload: Payload) -> bytes:
        """Return the bytes of a payload; PayloadLostError if they are gone."""

    def close(self) -> None:
        """Stop all workers at once."""
