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
        added_only: Whether only stages that add to exported scenes may run, because the pictures may be unavailable.
    """

    rows: Sequence[ImageRow]  # the whole manifest
    pipelines: Pipelines  # stages of each kind of row
    config: Config
    fingerprints: Mapping[SceneKind, Mapping[str, str]]  # of the stages of each kind of row (see `fingerprint_stages`)
    records_dir: StoragePath  # where the outputs of stages are kept
    keep: bool  # whether they stay there when their shard is committed
    todo: Sequence[int]  # ranks of the scenes to work on, in the plan's order
    added_only: bool = False
