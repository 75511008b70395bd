"""What a build is doing, in numbers: the driver counts, the command line shows."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Protocol

from schemas.work import Status


@dataclass(slots=True)
class Tally:
    """Counts of a running build.

    Attributes:
        stages: Names of all stages, in the order in which lines run through them.
        total: Scenes of the plan.
        before: Scenes that were accounted for when this run began.
        running: Calls under way, by stage.
        passed: Scenes that passed a stage in this run, by stage.
        ended: Scenes that ended in this run, by stage and status.
        committed: Shards that are whole.
        shards: All shards.
        losses: Workers and inputs that were lost in this run.
    """

    stages: tuple[str, ...]
    total: int
    before: int
    shards: int
    committed: int = 0
    losses: int = 0
    running: Counter[str] = field(default_factory=Counter)
    passed: Counter[str] = field(default_factory=Counter)
    ended: Counter[tuple[str, Status]] = field(default_factory=Counter)

    def count(self, status: Status) -> int:
        """Scenes that ended so in this run."""
        return sum(number for (_, ended), number in self.ended.items() if ended == status)

    @property
    def accounted(self) -> int:
        """Scenes that are accounted for, of this run and before."""
        return self.before + sum(self.ended.values())


class Display(Protocol):
    """Shows a tally; called often, so it decides itself when to draw."""

    def show(self, tally: Tally) -> None:
        """The tally has changed or time has passed."""

    def note(self, line: str) -> None:
        """Something that a person should read."""
