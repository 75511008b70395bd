"""Messages between executors: a call of a stage, its report, and the finished result of a scene."""

from dataclasses import dataclass
from typing import Literal

from schemas.outcome import NO_COST, UNLIMITED, Allowance, Dropped, Failed, ModelCost

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
    """Call of one stage on one scene; the input travels beside it as encoded bytes."""

    scene_id: str
    kind: str  # of the manifest row; it names the pipeline
    position: int  # index of the stage in that pipeline
    deadline_s: float  # wall time of one attempt [s]
    tried: int = 0  # failed attempts before, in chains that the budget interrupted


@dataclass(frozen=True, slots=True)
class StageChain:
    """Consecutive stages of one pool on one scene; the input travels beside it, or is a checkpoint."""

    calls: tuple[StageCall, ...]
    input_record: str  # name or location of the checkpoint that is the input; empty if the input travels beside
    output_records: tuple[str, ...]  # name of the checkpoint of each stage's output; empty if it has none
    allowance: Allowance = UNLIMITED  # of all of them together
    losses: int = 0  # how often a child was killed from outside before, in chains that the budget interrupted


@dataclass(frozen=True, slots=True)
class StageReport:
    """Report of a call; the next record travels beside it as encoded bytes."""

    outcome: Dropped | Failed | None  # None if the stage is done
    attempts: int  # the item's own, 1 or more; losses of the infrastructure do not count
    cpu_s: float  # of the last attempt [s]
    wall_s: float  # of the last attempt [s]
    trace: str = ""  # traceback of an error, for the log only: never part of the dataset
    cost: ModelCost = NO_COST  # of the answers when they were first given, by any build: a figure of the scene
    paid: ModelCost = NO_COST  # of this call: less, if answers were in the cache


@dataclass(frozen=True, slots=True)
class StageChainReport:
    """Report of a chain: a report of each stage that ran; only the last may be other than done."""

    stages: tuple[StageReport, ...]
    input_lost: bool = False  # nothing ran, because the checkpoint of the input is gone or damaged
    losses: int = 0  # how often a child was killed from outside, those of the chain before included
    counted: bool = True  # the reports hold all costs: those of a process that died are only in its cost log


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Time of one stage on one scene [s]."""

    stage: str
    cpu_s: float
    wall_s: float


@dataclass(frozen=True, slots=True)
class SceneResult:
    """Result of a scene, as the journal keeps it until its shard is committed."""

    scene_id: str
    status: Status
    stage: str  # the last that ran; `manifest` if the row was rejected
    reason: str  # code of a drop, else empty
    error_kind: str  # of a failure, else empty
    detail: str  # one line for people, of a drop or a failure
    attempts: int  # the most of any stage; 0 if none ran
    timings: tuple[StageTiming, ...]
    exported: bytes | None  # an encoded `ExportedScene`; None unless done
    costs: tuple[tuple[str, ModelCost], ...] = ()  # of the answers, by stage that asked one
