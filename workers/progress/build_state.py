"""State of a build, read from OUT while it may be running."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from schemas.tables import TIMINGS
from schemas.work import Status
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.columns import count_groups
from tableverse_factory.dataset.integrity import check_files
from tableverse_factory.dataset.model_costs import COST_COLUMNS
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.shards import committed_shards
from tableverse_factory.run_record import read_run
from workers.progress.scan import scan_shards

OUTCOME_COLUMNS = ("status", "stage", "reason", "error_kind")
LOST_COLUMNS = ("scene_id", *OUTCOME_COLUMNS, "detail", "attempts", "shard")
SCENE_COLUMNS = (*LOST_COLUMNS, "tar_size", *COST_COLUMNS)


@dataclass(frozen=True, slots=True)
class LostScene:
    """A scene that was dropped or has failed."""

    scene_id: str
    status: Status
    stage: str  # the last stage that ran
    why: str  # reason of a drop or kind of a failure
    detail: str  # one line of explanation
    attempts: int
    shard: int


@dataclass(frozen=True, slots=True)
class StageCost:
    """CPU time of one stage over all scenes that ran through it [s]."""

    stage: str
    scenes: int
    median_cpu_s: float
    p90_cpu_s: float
    total_cpu_s: float


@dataclass(frozen=True, slots=True, eq=False)
class BuildState:
    """Snapshot of a build, whose tables have columns of `schemas.tables.SCENES` and `TIMINGS`."""

    total: int  # scenes of the plan
    shards: int  # shards of the plan
    committed: int  # shards that are whole
    published: tuple[int, ...]  # numbers of the shards in OUT, also of those with scenes to recompute
    fingerprint: str  # of the configuration and the inputs
    scenes: pa.Table  # all scenes that are accounted for; `tar_size` is null where no shard holds the scene yet
    timings: pa.Table  # of these scenes, in the build that finished them
    stored: pa.Table  # rows of the published shards, also of scenes to recompute

    @property
    def done(self) -> int:
        """Number of finished scenes."""
        return self._count("done")

    @property
    def dropped(self) -> int:
        """Number of scenes that are unfit for the dataset."""
        return self._count("dropped")

    @property
    def failed(self) -> int:
        """Number of scenes with an error."""
        return self._count("failed")

    @property
    def remaining(self) -> int:
        """Number of scenes that are not accounted for."""
        return self.total - int(self.scenes.num_rows)

    def count_losses(self) -> dict[tuple[str, str, str], int]:
        """Count the lost scenes by (status, stage, why), the most frequent first."""
        counts = Counter[tuple[str, str, str]]()
        for (status, stage, reason, error_kind), count in count_groups(self._select_lost(), OUTCOME_COLUMNS).items():
            counts[status, stage, reason or error_kind or ""] += count
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def list_lost(self) -> list[LostScene]:
        """List the lost scenes, in the order of their shards."""
        rows = self._select_lost().select(list(LOST_COLUMNS)).to_pylist()
        for row in rows:
            why = (row.pop("reason"), row.pop("error_kind"))
            row |= {"why": why[0] or why[1] or "", "detail": row["detail"] or ""}
        return [LostScene(**row) for row in rows]

    def compute_stage_costs(self) -> tuple[StageCost, ...]:
        """Compute the CPU times of the stages, in the order in which they ran."""
        stages = pc.dictionary_encode(self.timings["stage"]).combine_chunks()
        codes, cpu_s = stages.indices.to_numpy(), self.timings["cpu_s"].to_numpy()
        return tuple(
            _compute_stage_cost(stage, np.sort(cpu_s[codes == code]))
            for code, stage in enumerate(stages.dictionary.to_pylist())
        )

    def _select_lost(self) -> pa.Table:
        return self.scenes.filter(pc.not_equal(self.scenes["status"], "done"))

    def _count(self, status: str) -> int:
        return int(pc.sum(pc.equal(self.scenes["status"], status)).as_py() or 0)


def read_build_state(
    out: StoragePath, columns: Sequence[str] = SCENE_COLUMNS, timing_columns: Sequence[str] = tuple(TIMINGS.names)
) -> BuildState:
    """Read the state of the build in `out`, with these columns of scenes and timings; safe while it runs."""
    run, plan = read_run(out / "run.json"), read_plan(out / "plan.parquet")
    published = committed_shards(out)
    check_files(out, published)
    rows = scan_shards(out, columns, timing_columns, plan.n_shards)
    return BuildState(
        total=len(plan.scene_ids),
        shards=plan.n_shards,
        committed=rows.whole,
        published=tuple(sorted(published)),
        fingerprint=run["fingerprint"],
        scenes=rows.scenes,
        timings=rows.timings,
        stored=rows.stored,
    )


def _compute_stage_cost(stage: str, ascending_s: NDArray[np.float64]) -> StageCost:
    n = len(ascending_s)
    middle_s = ascending_s[n // 2] if n % 2 else (ascending_s[n // 2 - 1] + ascending_s[n // 2]) / 2
    p90_s = ascending_s[math.ceil(0.9 * n) - 1]
    return StageCost(stage, n, float(middle_s), float(p90_s), float(ascending_s.sum()))
