"""What a run of the build is to do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.stage import Pipelines


@dataclass(frozen=True, slots=True)
class BuildSpec:
    """What is to be done, and with what.

    Attributes:
        rows: The whole manifest.
        lines: The stages of each kind of row.
        config: Of the build.
        fingerprints: Of the stages of each kind of row (see `stage_fingerprints`).
        records_dir: Where the output of every stage is kept.
        keep: Whether it stays there when its shard is committed.
        todo: Ranks of the scenes to work on, in the plan's order.
        added_only: Whether nothing but stages that add to exported scenes may run: their pictures may be far away.
    """

    rows: Sequence[ImageRow]
    lines: Pipelines
    config: Config
    fingerprints: Mapping[SceneKind, Mapping[str, str]]
    records_dir: StoragePath
    keep: bool
    todo: Sequence[int]
    added_only: bool = False
