"""State of a build, read from OUT while it may be running: committed shards, and the journals of open ones."""

import math
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from statistics import median

from upath import UPath

from schemas.outcome import ModelCost
from schemas.work import SceneResult, Status
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.integrity import check_files
from tableverse_factory.dataset.journals import (
    EMPTY_JOURNAL,
    WORK,
    find_journals,
    journal_path,
    read_journal,
    read_result,
)
from tableverse_factory.dataset.model_costs import COST_COLUMNS, make_cost_columns, sum_model_costs
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.shards import committed_shards, is_committed
from tableverse_factory.run_record import read_run

_SCENES = (
    *("scene_id", "status", "stage", "reason", "error_kind", "detail", "attempts", "shard", "tar_size"),
    *COST_COLUMNS,
)
_TIMINGS = ("scene_id", "stage", "cpu_s", "wall_s")
_ATTEMPTS = 4
_N_THREADS = 8

_Listing = tuple[frozenset[int], frozenset[int]]  # shards with a journal, and published ones, listed in this order


@dataclass(frozen=True, slots=True)
class SceneStatus:
    """A scene that is accounted for."""

    scene_id: str
    status: Status
    stage: str  # the last stage that ran
    why: str  # reason of a drop or kind of a failure; empty if it is done
    detail: str  # one line of explanation
    attempts: int
    shard: int
    timings: tuple[tuple[str, float, float], ...]  # (stage, CPU [s], wall [s]) in the build that finished it
    tar_bytes: int | None  # size of its files in the shard; None if no shard holds them yet
    costs: Mapping[str, ModelCost]  # of the answers of its models, by role


@dataclass(frozen=True, slots=True)
class StageCost:
    """CPU time of one stage over all scenes that ran through it [s]."""

    stage: str
    scenes: int
    median_cpu_s: float
    p90_cpu_s: float
    total_cpu_s: float


@dataclass(frozen=True, slots=True)
class BuildState:
    """Snapshot of a build."""

    total: int  # scenes of the plan
    shards: int  # shards of the plan
    committed: int  # shards that are whole
    published: tuple[int, ...]  # numbers of the shards in OUT, also of those with scenes to recompute
    fingerprint: str  # of the configuration and the inputs
    scenes: tuple[SceneStatus, ...]  # all scenes that are accounted for

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
        return self.total - len(self.scenes)

    def count_losses(self) -> dict[tuple[str, str, str], int]:
        """Count the lost scenes by (status, stage, why), the most frequent first."""
        counts = Counter((scene.status, scene.stage, scene.why) for scene in self.scenes if scene.status != "done")
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def compute_stage_costs(self) -> tuple[StageCost, ...]:
        """Compute the CPU times of the stages, in the order in which they ran."""
        times: dict[str, list[float]] = {}
        for scene in self.scenes:
            for stage, cpu_s, _ in scene.timings:
                times.setdefault(stage, []).append(cpu_s)
        ascending = {stage: sorted(seconds) for stage, seconds in times.items()}
        return tuple(
            StageCost(stage, len(seconds), median(seconds), seconds[math.ceil(0.9 * len(seconds)) - 1], sum(seconds))
            for stage, seconds in ascending.items()
        )

    def _count(self, status: str) -> int:
        return sum(scene.status == status for scene in self.scenes)


def read_build_state(out: StoragePath) -> BuildState:
    """Read the state of the build in `out`; safe while it runs."""
    run, plan = read_run(out / "run.json"), read_plan(out / "plan.parquet")
    published = committed_shards(out)
    check_files(out, published)
    shards = _read_shards(out, plan.n_shards)
    return BuildState(
        total=len(plan.scene_ids),
        shards=plan.n_shards,
        committed=sum(whole for whole, _ in shards),
        published=tuple(sorted(published)),
        fingerprint=run["fingerprint"],
        scenes=tuple(scene for _, scenes in shards for scene in scenes),
    )


def read_committed_scenes(out: StoragePath, shard: int) -> dict[str, SceneStatus]:
    """Read the scenes of a committed shard by id; FileNotFoundError if the shard is being replaced."""
    timings: dict[str, list[tuple[str, float, float]]] = {}
    for row in read_shard(out, "timings", shard, _TIMINGS).to_pylist():
        timings.setdefault(row["scene_id"], []).append((row["stage"], row["cpu_s"], row["wall_s"]))
    return {
        row["scene_id"]: SceneStatus(
            row["scene_id"],
            row["status"],
            row["stage"],
            row["reason"] or row["error_kind"] or "",
            row["detail"] or "",
            row["attempts"],
            row["shard"],
            tuple(timings.get(row["scene_id"], ())),
            row["tar_size"] or 0,
            sum_model_costs([row]),
        )
        for row in read_shard(out, "scenes", shard, _SCENES).to_pylist()
    }


def make_scene_status(result: SceneResult, shard: int) -> SceneStatus:
    """Make the status of a scene from its result in a journal."""
    return SceneStatus(
        result.scene_id,
        result.status,
        result.stage,
        result.reason or result.error_kind,
        result.detail,
        result.attempts,
        shard,
        tuple((timing.stage, timing.cpu_s, timing.wall_s) for timing in result.timings),
        None,
        sum_model_costs([make_cost_columns(result.costs)]),
    )


def _list_shards(out: StoragePath) -> _Listing:
    return find_journals(list_names(out / WORK)), committed_shards(out)


def _read_shards(out: StoragePath, n_shards: int) -> list[tuple[bool, list[SceneStatus]]]:
    """Read every shard, in order; in a store several at once, because reads mostly wait for answers."""
    read = partial(_read_with_retries, out, _list_shards(out))
    if not isinstance(out, UPath):
        return list(map(read, range(n_shards)))
    with ThreadPoolExecutor(_N_THREADS) as threads:
        return list(threads.map(read, range(n_shards)))


def _read_with_retries(out: StoragePath, listing: _Listing, shard: int) -> tuple[bool, list[SceneStatus]]:
    for _ in range(_ATTEMPTS):
        try:
            return _read_shard(out, shard, listing)
        except FileNotFoundError:  # committed meanwhile: list again
            listing = _list_shards(out)
    return _read_shard(out, shard, listing)


def _read_shard(out: StoragePath, shard: int, listing: _Listing) -> tuple[bool, list[SceneStatus]]:
    """Read whether a shard is whole, and its scenes: results in its journal take precedence over committed rows."""
    journals, published = listing
    path = journal_path(out, shard)
    journal = read_journal(path) if shard in journals else EMPTY_JOURNAL
    whole = shard in published
    if not whole and shard in journals and not journal.results and is_committed(out, shard):
        raise FileNotFoundError(str(path))
    # one result at a time: each holds all files of its scene
    scenes = [make_scene_status(read_result(path, entry), shard) for entry in journal.results.values()]
    if whole:
        replaced = journal.reopened | set(journal.results)
        scenes += [scene for name, scene in read_committed_scenes(out, shard).items() if name not in replaced]
    return whole and not journal.reopened, scenes
