"""Outcome of a stage: the next record, a reason to drop the scene, or an error; and the cost of its model requests."""

from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T", covariant=True)

MAX_DETAIL_CHARS = 2000


@dataclass(frozen=True, slots=True)
class Done(Generic[T]):
    """Result of the stage, passed to the next one."""

    value: T


@dataclass(frozen=True, slots=True)
class Dropped:
    """Scene that is valid input but unfit for the dataset: a true reason, never an accident.

    Attributes:
        reason: Stable snake_case code to count by, e.g. `no_table_plane`.
        detail: One line for people, with the values that decided it.
    """

    reason: str
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}" if self.detail else self.reason


@dataclass(frozen=True, slots=True)
class Failed:
    """Failure: an exception, a crash, a hang.

    Attributes:
        error_kind: `exception`, `crash`, `timeout`, `out_of_memory`, `lost` (its process or machine was killed
            repeatedly), or the class of a `TableverseError`.
        message: One bounded line.
    """

    error_kind: str
    message: str

    def __str__(self) -> str:
        return f"{self.error_kind}: {self.message}"


Outcome = Done[T] | Dropped | Failed


@dataclass(frozen=True, slots=True)
class ModelCost:
    """Cost of requests to model servers.

    Attributes:
        calls: Requests, including retries.
        input_tokens: As servers counted them; 0 if they did not.
        output_tokens: Likewise.
        usd: By the prices of the configuration [USD].
    """

    calls: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    usd: float = 0.0

    def __add__(self, other: "ModelCost") -> "ModelCost":
        return ModelCost(
            self.calls + other.calls,
            self.input_tokens + other.input_tokens,
            self.output_tokens + other.output_tokens,
            self.usd + other.usd,
        )

    def __bool__(self) -> bool:
        return self != NO_COST


NO_COST = ModelCost()


@dataclass(frozen=True, slots=True)
class Allowance:
    """Budget that a chain of stages may still spend on model requests; None for no limit.

    Attributes:
        usd: A request may begin as long as less than this is spent [USD].
        name: Under which costs are logged; empty if no model is asked.
    """

    calls: int | None = None
    usd: float | None = None
    name: str = ""

    @property
    def is_limited(self) -> bool:
        """Whether it has a limit."""
        return self.calls is not None or self.usd is not None


UNLIMITED = Allowance()
