"""Messages between executors: a call of a stage, its report, and the finished result of a scene."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, NonNegativeInt

from schemas.manifest import ImageRow
from schemas.outcome import CHECKED, NO_COST, UNLIMITED, Allowance, Dropped, Failed, ModelCost

Status = Literal["done", "dropped", "failed"]


@dataclass(frozen=True, slots=True)
class SandboxSetup:
    """Configuration of a sandbox, sent before its first call."""

    pipeline: str  # where the pipelines are defined, `module:attribute`
    config_json: str
    cache_dir: str  # content-addressed cache on the machine that runs the sandbox
    attempts: int  # of a stage that crashes, hangs or runs out of memory on a scene
    memory_mb: int  # resident memory of the child [MB]
    records_dir: str  # folder of the checkpoints


@dataclass(frozen=True, slots=True)
class StageCall:
    """Call of one stage on one scene."""

    deadline_s: float  # wall time of one attempt [s]
    key: str  # of the checkpoint of its output; empty for the last stage, whose output is the finished scene
    tried: int = 0  # failed attempts before, in chains that the budget interrupted


@dataclass(frozen=True, slots=True)
class StageChain:
    """Consecutive stages of one pool on one scene."""

    row: ImageRow
    shard: int
    position: int  # of the first of them in the pipeline of the row's kind
    calls: tuple[StageCall, ...]
    input: str = ""  # location of the checkpoint that is the input; empty for the row itself
    allowance: Allowance = UNLIMITED  # of all of them together
    losses: int = 0  # how often a child was killed from outside before, in chains that the budget interrupted
    failure: Failed | Dropped | None = None  # of a stage that adds to finished scenes: its rows are written instead
    new_child: bool = False  # the first stage failed in a used child before, in a chain that the budget interrupted


@dataclass(frozen=True, slots=True)
class StageReport:
    """Report of a call."""

    outcome: Dropped | Failed | None  # None if the stage is done
    attempts: int  # the item's own, 1 or more; losses of the infrastructure and failures in used children do not count
    cpu_s: float  # of the last attempt [s]
    wall_s: float  # of the last attempt [s]
    trace: str = ""  # traceback of an error, for the log only: never part of the dataset
    cost: ModelCost = NO_COST  # of the answers when they were first given, by any build: a figure of the scene
    paid: ModelCost = NO_COST  # of this call: less, if answers were in the cache


@dataclass(frozen=True, slots=True)
class ScenePart:
    """Place of a finished scene until its shard is committed (see `dataset.parts`)."""

    __pydantic_config__: ClassVar[ConfigDict] = CHECKED

    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$")]  # in the shard's folder of parts
    offset: NonNegativeInt  # of the frame of its rows; that of its files follows [bytes]
    rows_size: NonNegativeInt  # of the encoded rows [bytes]
    files_size: NonNegativeInt  # of its files as members of a tar [bytes]


@dataclass(frozen=True, slots=True)
class StageChainReport:
    """Report of a chain: a report of each stage that ran; only the last may be other than done."""

    stages: tuple[StageReport, ...]
    output: ScenePart | str = ""  # of the last that is done: the finished scene, or the location of its checkpoint
    input_lost: bool = False  # nothing ran, because the checkpoint of the input is gone or damaged
    losses: int = 0  # how often a child was killed from outside, those of the chain before included
    counted: bool = True  # the reports hold all costs: those of a process that died are only in its cost log
    new_child: bool = False  # the stage that ended the chain failed in a used child before


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Time of one stage on one scene [s]."""

    __pydantic_config__: ClassVar[ConfigDict] = CHECKED

    stage: str
    cpu_s: float
    wall_s: float


@dataclass(frozen=True, slots=True)
class SceneResult:
    """Result of a scene, as the journal keeps it until its shard is committed."""

    __pydantic_config__: ClassVar[ConfigDict] = CHECKED

    row: ImageRow
    status: Status
    stage: str  # the last that ran; `manifest` if the row was rejected
    reason: str = ""  # code of a drop
    error_kind: str = ""  # of a failure
    detail: str = ""  # one line for people, of a drop or a failure
    attempts: int = 0  # the most of any stage; 0 if none ran
    timings: tuple[StageTiming, ...] = ()
    part: ScenePart | None = None  # None unless done
    costs: tuple[tuple[str, ModelCost], ...] = ()  # of the answers, by stage that asked one

    @property
    def scene_id(self) -> str:
        """Id of the scene."""
        return self.row.scene_id


@dataclass(frozen=True, slots=True)
class CommitCall:
    """Call that assembles a shard, whose scenes all have results, for its commit."""

    shard: int
    scene_ids: tuple[str, ...]  # of the shard, in the plan's order
    post_export: tuple[str, ...]  # names of the stages that add to finished scenes
    token: str  # names the staging folder, which is this call's own


@dataclass(frozen=True, slots=True)
class StagedShard:
    """A shard that a worker assembled, to be published by the driver."""

    token: str
    size: int  # of its scenes and tables [bytes]
    empty: tuple[str, ...]  # tables without rows, which have no file
    damaged: tuple[str, ...] = ()  # scenes whose parts do not read; nothing is staged then
