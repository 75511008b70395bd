"""Messages between executors: a call of a stage, its report, and the finished result of a scene."""

from dataclasses import dataclass
from typing import Literal

from schemas.outcome import NO_COST, UNLIMITED, Allowance, Dropped, Failed, ModelCost

Status = Literal["done", "dropped", "failed"]


@dataclass(frozen=True, slots=True)
class SandboxSetup:
    """Configuration of a sandbox, sent before its first call.

    Attributes:
        pipeline: Location of the pipelines, as `module:attribute`.
        config_json: The whole configuration.
        cache_dir: Content-addressed cache on the machine that runs the sandbox.
        attempts: Attempts of a stage that crashes, hangs or runs out of memory on a scene.
        memory_mb: Resident memory of the child [MB].
        records_dir: Folder of the checkpoints.
    """

    pipeline: str
    config_json: str
    cache_dir: str
    attempts: int
    memory_mb: int
    records_dir: str


@dataclass(frozen=True, slots=True)
class StageCall:
    """Call of one stage on one scene; the input travels beside it as encoded bytes.

    Attributes:
        kind: Kind of the manifest row, which names the pipeline.
        position: Index of the stage in that pipeline.
        deadline_s: Wall time of one attempt [s].
        tried: Failed attempts before, in chains that the budget interrupted.
    """

    scene_id: str
    kind: str
    position: int
    deadline_s: float
    tried: int = 0


@dataclass(frozen=True, slots=True)
class StageChain:
    """Consecutive stages of one pool on one scene; the input travels beside it, or is a checkpoint.

    Attributes:
        calls: The stages, in order.
        input_record: Name or location of the checkpoint that is the input; empty if the input travels beside.
        output_records: Name of the checkpoint of each stage's output; empty if it has none.
        allowance: Budget of all of them together for model requests.
        losses: How often a child was killed from outside before, in chains that the budget interrupted.
    """

    calls: tuple[StageCall, ...]
    input_record: str
    output_records: tuple[str, ...]
    allowance: Allowance = UNLIMITED
    losses: int = 0


@dataclass(frozen=True, slots=True)
class StageReport:
    """Report of a call; the next record travels beside it as encoded bytes.

    Attributes:
        outcome: None if the stage is done.
        attempts: The item's own attempts, 1 or more; losses of the infrastructure do not count.
        cpu_s: CPU time of the last attempt [s].
        wall_s: Wall time of the last attempt [s].
        trace: Traceback of an error, for the log only: never part of the dataset.
        cost: Cost of the models' answers when they were first given, by any build: a figure of the scene.
        paid: Cost of this call: less, if answers were in the cache.
    """

    outcome: Dropped | Failed | None
    attempts: int
    cpu_s: float
    wall_s: float
    trace: str = ""
    cost: ModelCost = NO_COST
    paid: ModelCost = NO_COST


@dataclass(frozen=True, slots=True)
class StageChainReport:
    """Report of a chain: a report of each stage that ran; only the last may be other than done.

    Attributes:
        input_lost: Whether nothing ran, because the checkpoint of the input is gone or damaged.
        losses: How often a child was killed from outside, those of the chain before included.
        counted: Whether the reports hold all costs: those of a process that died are only in its cost log.
    """

    stages: tuple[StageReport, ...]
    input_lost: bool = False
    losses: int = 0
    counted: bool = True


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Time of one stage on one scene [s]."""

    stage: str
    cpu_s: float
    wall_s: float


@dataclass(frozen=True, slots=True)
class SceneResult:
    """Result of a scene, as the journal keeps it until its shard is committed.

    Attributes:
        stage: The last stage that ran; `manifest` if the row was rejected.
        reason: Code of a drop, else empty.
        error_kind: Kind of a failure, else empty.
        detail: One line for people, of a drop or a failure.
        attempts: The most attempts of any stage; 0 if none ran.
        exported: An encoded `ExportedScene`; None unless done.
        costs: Costs of the models' answers, by stage that asked one.
    """

    scene_id: str
    status: Status
    stage: str
    reason: str
    error_kind: str
    detail: str
    attempts: int
    timings: tuple[StageTiming, ...]
    exported: bytes | None
    costs: tuple[tuple[str, ModelCost], ...] = ()
