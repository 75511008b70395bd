"""Outcome of a stage: the next record, a reason to drop the scene, or an error; and the cost of its model requests."""

from dataclasses import astuple, dataclass
from typing import ClassVar, Generic, TypeVar

from pydantic import ConfigDict

T = TypeVar("T", covariant=True)

MAX_DETAIL_CHARS = 2000
CHECKED = ConfigDict(revalidate_instances="always", strict=True)
"""Configuration of records in files that may come from elsewhere: pydantic checks their fields (`dataset.journals`)."""


@dataclass(frozen=True, slots=True)
class Done(Generic[T]):
    """Result of the stage, passed to the next one."""

    value: T


@dataclass(frozen=True, slots=True)
class Dropped:
    """Scene that is valid input but unfit for the dataset: a true reason, never an accident.

    `reason` is a stable snake_case code to count by, such as `no_table_plane`; `detail` one line with the values that
    decided it.
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
    """

    error_kind: str
    message: str

    def __str__(self) -> str:
        return f"{self.error_kind}: {self.message}"


Outcome = Done[T] | Dropped | Failed


@dataclass(frozen=True, slots=True)
class ModelCost:
    """Cost of requests with retries: tokens as servers counted them, or 0; the configured price [USD]."""

    __pydantic_config__: ClassVar[ConfigDict] = CHECKED

    calls: int = 0
    input_tokens: int = 0
    output_tokens: int = 0
    usd: float = 0.0

    def __add__(self, other: "ModelCost") -> "ModelCost":
        return ModelCost(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def __bool__(self) -> bool:
        return self != NO_COST


NO_COST = ModelCost()


@dataclass(frozen=True, slots=True)
class Allowance:
    """Budget that a chain of stages may still spend on model requests; None for no limit."""

    calls: int | None = None
    usd: float | None = None  # a request may begin as long as less than this is spent [USD]
    name: str = ""  # under which costs are logged; empty if no model is asked

    @property
    def is_limited(self) -> bool:
        """Whether it has a limit."""
        return self.calls is not None or self.usd is not None


UNLIMITED = Allowance()
