"""Input of the driver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.stage import Pipelines


@dataclass(frozen=True, slots=True)
class BuildSpec:
    """The work of one run of a build.

    Attributes:
        rows: The whole manifest.
        pipelines: Stages of each kind of row.
        config: Of the build.
        fingerprints: Of the stages of each kind of row (see `fingerprint_stages`).
        records_dir: Where the outputs of stages are kept.
        keep: Whether they stay there when their shard is committed.
        todo: Ranks of the scenes to work on, in the plan's order.
        added_only: Whether only stages that add to exported scenes may run, because the pictures may be unavailable.
    """

    rows: Sequence[ImageRow]
    pipelines: Pipelines
    config: Config
    fingerprints: Mapping[SceneKind, Mapping[str, str]]
    records_dir: StoragePath
    keep: bool
    todo: Sequence[int]
    added_only: bool = False
