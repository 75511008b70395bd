"""A scene inside the stages: how far it has come, and where the input of its next stage lies."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from schemas.codec import encode
from schemas.manifest import ImageRow
from schemas.outcome import ModelCost
from schemas.work import StageTiming
from tableverse_factory.stage import Stage
from workers.executors.protocol import Payload
from workers.state.checkpoint_store import CheckpointRef


@dataclass(slots=True)
class InFlightScene:
    """A scene inside the stages.

    Attributes:
        tried: Failed attempts of its stages, by position, in calls that the budget interrupted.
    """

    rank: int
    row: ImageRow
    stages: Sequence[Stage]  # of its pipeline
    records: tuple[str, ...]  # names of the checkpoints of its stages; empty for an output that is not kept
    input_record: str = ""  # place of the checkpoint that is the input of its next stage; empty if the payload is
    payload: Payload = b""  # input of its next stage; empty if it is a checkpoint
    position: int = 0  # its next stage, or the first of those that run
    attempts: int = 0  # most attempts that any stage needed
    losses: int = 0  # how often its worker was lost
    tried: Counter[int] = field(default_factory=Counter)
    child_losses: int = 0  # how often a child was killed from outside in such calls
    timings: list[StageTiming] = field(default_factory=list)
    costs: dict[str, ModelCost] = field(default_factory=dict)  # costs of the model calls of its stages

    @property
    def stage(self) -> Stage:
        """Its next stage, or the first of those that run."""
        return self.stages[self.position]

    def start(self, checkpoints: Mapping[str, CheckpointRef]) -> None:
        """Move behind the last stage with a checkpoint, or to the first stage."""
        done = [position for position, name in enumerate(self.records) if name in checkpoints]
        if done:
            self.position, self.payload, self.input_record = (
                done[-1] + 1,
                b"",
                checkpoints[self.records[done[-1]]].location,
            )
        else:
            self.position, self.payload, self.input_record = 0, encode(self.row), ""

    def resume(self, checkpoints: Mapping[str, CheckpointRef], input_lost: bool) -> None:
        """Move behind the last stage with a checkpoint if that is further, or if the input is lost."""
        furthest = max((position for position, name in enumerate(self.records) if name in checkpoints), default=-1)
        if input_lost or furthest >= self.position:
            self.start(checkpoints)
            passed = {stage.name for stage in self.stages[: self.position]}
            self.timings = [timing for timing in self.timings if timing.stage in passed]
            self.costs = {stage: cost for stage, cost in self.costs.items() if stage in passed}
