"""What the driver asks of an executor; `local` and `ray` answer the same, so the driver does not know which it has."""

from dataclasses import dataclass
from typing import Any, Protocol

from schemas.work import StageChain, StageChainReport
from workers.executors.schedule import ScheduleLimits

Payload = Any
"""An encoded record where it lies: bytes in this process, or a reference into Ray's object store."""


@dataclass(frozen=True, slots=True)
class Job:
    """One scene's part of a call.

    Attributes:
        rank: The scene's rank in the plan.
        chain: Which stages.
        payload: Their input; empty where the chain names a record.
    """

    rank: int
    chain: StageChain
    payload: Payload


@dataclass(frozen=True, slots=True)
class Answer:
    """How a job ended, and the next record where all of its stages are done."""

    rank: int
    report: StageChainReport
    payload: Payload


@dataclass(frozen=True, slots=True)
class WorkerReady:
    """A worker that is there now, and idle."""

    worker: int


@dataclass(frozen=True, slots=True)
class CallFinished:
    """A call that ended.

    Attributes:
        worker: Who ran it.
        answers: One for each of its jobs.
    """

    worker: int
    answers: tuple[Answer, ...]


@dataclass(frozen=True, slots=True)
class WorkerLost:
    """A worker that is gone for good; the scenes of its call are not to blame.

    Attributes:
        worker: Who.
        ranks: The scenes of its call; none where it never came to be.
        why: What was lost, in words.
        inputs_lost: Whether inputs of the call are gone, too.
    """

    worker: int
    ranks: tuple[int, ...]
    why: str
    inputs_lost: bool = False


Event = WorkerReady | CallFinished | WorkerLost


class PayloadLostError(Exception):
    """A record that lay on a lost machine."""


class Executor(Protocol):
    """Workers in pools, one call in flight per worker."""

    @property
    def limits(self) -> ScheduleLimits:
        """How many workers there may be."""

    def pool_of(self, stage_pool: str) -> str:
        """The pool that runs stages which ask for `stage_pool`."""

    def start(self, pool: str) -> int:
        """Asks for a worker; returns its number. It is there when `wait` says so, which may take for ever."""

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        """Hands a call to an idle worker."""

    def wait(self, timeout_s: float) -> list[Event]:
        """What happened since the last time; waits for the first event at most so long.

        Raises:
            BuildError: if a worker says that it can never work.
        """

    def retire(self, worker: int) -> None:
        """Ends an idle worker."""

    def fetch(self, payload: Payload) -> bytes:
        """The bytes of a payload.

        Raises:
            PayloadLostError: if they are gone.
        """

    def close(self) -> None:
        """Ends all workers at once."""
