"""What the executors pass around: a call of one stage, its report, and the finished result of a scene."""

from dataclasses import dataclass
from typing import Literal

from schemas.outcome import NO_COST, UNLIMITED, Allowance, Dropped, Failed, ModelCost

Status = Literal["done", "dropped", "failed"]


@dataclass(frozen=True, slots=True)
class SandboxSetup:
    """What a sandbox needs before its first call.

    Attributes:
        pipeline: Where the lines are, as `module:attribute`.
        config_json: The whole configuration.
        cache_dir: Content-addressed cache on the machine that runs the sandbox.
        attempts: How often a stage may crash, hang or run out of memory on a scene before it is failed.
        memory_mb: Resident memory of the child [MB].
        records_dir: Where the output of every stage is kept.
    """

    pipeline: str
    config_json: str
    cache_dir: str
    attempts: int
    memory_mb: int
    records_dir: str


@dataclass(frozen=True, slots=True)
class StageCall:
    """One stage on one scene; the input travels beside it as encoded bytes.

    Attributes:
        kind: Kind of the manifest row, which names the line.
        position: Index of the stage in that line.
        deadline_s: Wall time of one attempt [s].
        tried: Attempts that came to nothing before, in chains that the budget broke off.
    """

    scene_id: str
    kind: str
    position: int
    deadline_s: float
    tried: int = 0


@dataclass(frozen=True, slots=True)
class StageChain:
    """Consecutive stages on one scene, all of one pool; the input travels beside it, or lies among the records.

    Attributes:
        calls: The stages, in order.
        input_record: Name or place of the record that is the input; empty where the input travels beside.
        output_records: Name under which the output of each stage is kept; empty where it is not.
        allowance: What all of them together may spend on questions to models.
        losses: How often a child was killed from outside before, in chains that the budget broke off.
    """

    calls: tuple[StageCall, ...]
    input_record: str
    output_records: tuple[str, ...]
    allowance: Allowance = UNLIMITED
    losses: int = 0


@dataclass(frozen=True, slots=True)
class StageReport:
    """How a call ended; the next record travels beside it as encoded bytes.

    Attributes:
        outcome: None where the stage is done.
        attempts: The item's own attempts, 1 or more; losses of the infrastructure do not count.
        cpu_s: CPU time of the last attempt [s].
        wall_s: Wall time of the last attempt [s].
        trace: Where an error was raised, for the log only: never part of the dataset.
        cost: What the models' answers cost when they were first given, whoever asked for them: a figure of the scene.
        paid: What was spent just now: less, where answers were in the cache.
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
    """How a chain ended: a report of each stage that ran; only the last may be other than done.

    Attributes:
        input_lost: Whether nothing ran, because the record that is the input is gone or damaged.
        losses: How often a child was killed from outside, those of the chain before included.
        counted: Whether the reports say all that was spent: what a process spent that died stands nowhere but where it
            wrote it down.
    """

    stages: tuple[StageReport, ...]
    input_lost: bool = False
    losses: int = 0
    counted: bool = True


@dataclass(frozen=True, slots=True)
class StageTiming:
    """What one stage cost on one scene [s]."""

    stage: str
    cpu_s: float
    wall_s: float


@dataclass(frozen=True, slots=True)
class SceneResult:
    """A scene that is accounted for, as the journal keeps it until its shard is committed.

    Attributes:
        stage: The last stage that ran; `manifest` where the row could not enter.
        reason: Code of a drop, else empty.
        error_kind: Kind of a failure, else empty.
        detail: One line for people, of a drop or a failure.
        attempts: The most attempts that any stage needed; 0 where none ran.
        exported: An encoded `ExportedScene`; None unless done.
        costs: What the answers of models cost, by stage; only of those that asked one.
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
