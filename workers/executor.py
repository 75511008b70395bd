"""What the driver asks of an executor; `local` and `ray` answer the same, so the driver does not know which it has."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from schemas.work import StageCall, StageReport

Payload = Any
"""An encoded record where it lies: bytes in this process, or a reference into Ray's object store."""


@dataclass(frozen=True, slots=True)
class Job:
    """One call for one worker.

    Attributes:
        rank: The scene's rank in the plan.
        call: Which stage.
        payload: Its input.
    """

    rank: int
    call: StageCall
    payload: Payload


@dataclass(frozen=True, slots=True)
class Ended:
    """How a job ended.

    Attributes:
        worker: Who ran it.
        report: None where the worker or its machine was lost: the scene is not to blame.
        payload: The next record where the stage is done.
        loss: What was lost, in words.
        input_lost: Whether the job's input is gone, too.
    """

    worker: int
    rank: int
    report: StageReport | None
    payload: Payload = None
    loss: str = ""
    input_lost: bool = False


class PayloadLostError(Exception):
    """A record that lay on a lost machine."""


class Executor(Protocol):
    """Workers in pools, one call in flight per worker."""

    @property
    def calls(self) -> int:
        """Calls in flight at most."""

    @property
    def pools(self) -> Mapping[str, int]:
        """Workers of each pool at most."""

    def pool_of(self, stage_pool: str) -> str:
        """The pool that runs stages which ask for `stage_pool`."""

    def start(self, pool: str) -> int:
        """Starts a worker; returns its number. It may still be starting when it gets its first job."""

    def submit(self, worker: int, job: Job) -> None:
        """Hands a job to an idle worker."""

    def wait(self, timeout_s: float) -> list[Ended]:
        """Jobs that ended since the last call; waits for the first at most so long. A lost worker is gone for good.

        Raises:
            BuildError: if a worker says that it can never work.
        """

    def fetch(self, payload: Payload) -> bytes:
        """The bytes of a payload.

        Raises:
            PayloadLostError: if they are gone.
        """

    def close(self) -> None:
        """Ends all workers at once."""
