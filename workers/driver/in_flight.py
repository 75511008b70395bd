"""The work of a run, and a scene inside the stages: how far it has come, and where the input of its next stage lies."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Dropped, Failed, ModelCost
from schemas.work import StageTiming
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.stage import Pipelines, Stage
from workers.state.checkpoint_store import CheckpointRef


@dataclass(frozen=True, slots=True)
class BuildSpec:
    """The work of one run of a build."""

    rows: Sequence[ImageRow]  # the whole manifest
    kinds: Collection[SceneKind]  # of the rows
    shards: Sequence[int]  # of each row
    pipelines: Pipelines  # stages of each kind of row
    config: Config
    fingerprints: Mapping[SceneKind, Mapping[str, str]]  # of the stages of each kind of row (see `fingerprint_stages`)
    records_dir: StoragePath  # where the outputs of stages are kept
    todo: Sequence[int]  # ranks of the scenes to work on, in the plan's order
    added_only: bool = False  # whether only stages that add to exported scenes may run: the pictures may be gone


@dataclass(slots=True)
class InFlightScene:
    """A scene inside the stages."""

    rank: int
    row: ImageRow
    shard: int
    stages: Sequence[Stage]  # of its pipeline
    records: tuple[str, ...]  # names of the checkpoints of its stages; empty for an output that is not kept
    input: str = ""  # location of the checkpoint that is the input of its next stage; empty for the row
    position: int = 0  # its next stage, or the first of those that run
    attempts: int = 0  # most attempts that any stage needed
    losses: int = 0  # how often its worker was lost
    tried: Counter[int] = field(default_factory=Counter)  # failed attempts by position, in calls the budget interrupted
    child_losses: int = 0  # how often a child was killed from outside in such calls
    new_child: bool = False  # whether its next stage failed in a used child in such a call
    timings: list[StageTiming] = field(default_factory=list)
    costs: dict[str, ModelCost] = field(default_factory=dict)  # costs of the model calls of its stages
    failure: Failed | Dropped | None = None  # of its stage, whose rows of failure are to be written

    @property
    def stage(self) -> Stage:
        """Its next stage, or the first of those that run."""
        return self.stages[self.position]

    def start(self, checkpoints: Mapping[str, CheckpointRef]) -> None:
        """Move behind the last stage with a checkpoint, or to the first stage."""
        found = [position for position, name in enumerate(self.records) if name in checkpoints]
        self.position = 1 + max(found, default=-1)
        self.input = checkpoints[self.records[self.position - 1]].location if self.position else ""

    def resume(self, checkpoints: Mapping[str, CheckpointRef]) -> None:
        """Move behind the last stage with a checkpoint, forward or back."""
        position = self.position
        self.start(checkpoints)
        if self.position != position:
            self.failure = None
        passed = {stage.name for stage in self.stages[: self.position]}
        self.timings = [timing for timing in self.timings if timing.stage in passed or self.failure is not None]
        self.costs = {stage: cost for stage, cost in self.costs.items() if stage in passed}
