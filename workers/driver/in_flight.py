"""A scene inside the line: how far it has come, and where the input of its next stage lies."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from schemas.codec import encode
from schemas.manifest import ImageRow
from schemas.outcome import Spent
from schemas.work import StageTiming
from tableverse_factory.stage import Stage
from workers.executors.protocol import Payload
from workers.state.checkpoint_store import CheckpointRef


@dataclass(slots=True)
class InFlightScene:
    """A scene inside the line.

    Attributes:
        records: Names of what its stages give, one per stage; empty where it is not kept.
        kept: Where the record lies that is the input of its next stage; empty where the payload is.
        payload: The input of its next stage; empty where it is the record of the stage before.
        position: Its next stage, or the first of those that run.
        attempts: The most attempts that any stage needed.
        losses: How often its worker was lost.
        tried: Attempts of its stages, by position, that came to nothing in calls that the budget broke off.
        child_losses: How often a child was killed from outside in such calls.
        costs: What the questions of its stages cost, of those that asked any.
    """

    rank: int
    row: ImageRow
    line: Sequence[Stage]
    records: tuple[str, ...]
    kept: str = ""
    payload: Payload = b""
    position: int = 0
    attempts: int = 0
    losses: int = 0
    tried: Counter[int] = field(default_factory=Counter)
    child_losses: int = 0
    timings: list[StageTiming] = field(default_factory=list)
    costs: dict[str, Spent] = field(default_factory=dict)

    @property
    def stage(self) -> Stage:
        """Its next stage, or the first of those that run."""
        return self.line[self.position]

    def begin(self, known: Mapping[str, CheckpointRef]) -> None:
        """Puts it behind the last stage whose output is kept, or at its beginning."""
        done = [position for position, name in enumerate(self.records) if name in known]
        if done:
            self.position, self.payload, self.kept = done[-1] + 1, b"", known[self.records[done[-1]]].place
        else:
            self.position, self.payload, self.kept = 0, encode(self.row), ""

    def resume(self, known: Mapping[str, CheckpointRef], input_lost: bool) -> None:
        """Puts it behind the last stage whose output is kept, if that is further or its input is lost."""
        furthest = max((position for position, name in enumerate(self.records) if name in known), default=-1)
        if input_lost or furthest >= self.position:
            self.begin(known)
            passed = {stage.name for stage in self.line[: self.position]}
            self.timings = [timing for timing in self.timings if timing.stage in passed]
            self.costs = {stage: cost for stage, cost in self.costs.items() if stage in passed}
