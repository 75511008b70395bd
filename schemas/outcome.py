"""What a stage may answer: the next record, a reason to drop the scene, or an error."""

from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T", covariant=True)

MAX_DETAIL_CHARS = 2000


@dataclass(frozen=True, slots=True)
class Done(Generic[T]):
    """The stage's result, handed to the next stage."""

    value: T


@dataclass(frozen=True, slots=True)
class Dropped:
    """The scene is sound input but not fit for the dataset: a true reason, never an accident.

    Attributes:
        reason: Stable snake_case code to count by, e.g. `no_table_plane`.
        detail: One line for people, with the values that decided it.
    """

    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """Something broke: an exception, a crash, a hang.

    Attributes:
        error_kind: `exception`, `crash`, `timeout`, `out_of_memory`, `lost` (its process or machine was taken away
            again and again), or the class of a `TableverseError`.
        message: One bounded line.
    """

    error_kind: str
    message: str


Outcome = Done[T] | Dropped | Failed
