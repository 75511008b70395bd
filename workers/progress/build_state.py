"""Where a build stands, read from OUT without disturbing it: committed shards, and the journals of the open ones."""

import math
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

from upath import UPath

from schemas.work import SceneResult
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.integrity import check_files
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.shards import committed_shards, is_committed, read_shard, shard_path
from tableverse_factory.run_record import read_run
from workers.state.journal import find_journals, read_journal, read_result
from workers.state.journal_frames import EMPTY_JOURNAL
from workers.state.ledger import WORK, journal_path

_COLUMNS = ("scene_id", "status", "stage", "reason", "error_kind", "detail", "attempts", "shard")
_LOOKS = 4
_AT_ONCE = 8


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """How one scene ended, from wherever it is written down.

    Attributes:
        why: Code of a drop or kind of a failure; empty where it is done.
        detail: One line for people.
    """

    scene_id: str
    status: str
    stage: str
    why: str
    detail: str
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


@dataclass(frozen=True, slots=True)
class BuildState:
    """Where a build stands.

    Attributes:
        total: Scenes of the plan.
        committed: Shards that are whole.
        shards: All shards.
        endings: Every scene that is accounted for.
        costs: What the stages cost, in the order in which they ran.
    """

    total: int
    committed: int
    shards: int
    fingerprint: str
    endings: tuple[SceneOutcome, ...]
    costs: tuple[StageCost, ...]

    @property
    def done(self) -> int:
        """Scenes in the dataset."""
        return self._count("done")

    @property
    def dropped(self) -> int:
        """Scenes that are not fit for it."""
        return self._count("dropped")

    @property
    def failed(self) -> int:
        """Scenes on which something broke."""
        return self._count("failed")

    @property
    def remaining(self) -> int:
        """Scenes that nothing is known of yet."""
        return self.total - len(self.endings)

    def funnel(self) -> dict[tuple[str, str, str], int]:
        """Scenes that were lost, by (status, stage, why), the most frequent first."""
        counts = Counter((e.status, e.stage, e.why) for e in self.endings if e.status != "done")
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def _count(self, status: str) -> int:
        return sum(ending.status == status for ending in self.endings)


def read_build_state(out: StoragePath) -> BuildState:
    """Reads where the build in `out` stands; safe while it runs.

    Raises:
        BuildError: if there is no build, or a committed shard has lost a file.
    """
    run, plan = read_run(out / "run.json"), read_plan(out / "plan.parquet")
    check_files(out, committed_shards(out))
    endings: list[SceneOutcome] = []
    costs: dict[str, list[float]] = {}
    committed = 0
    for seen in _look_at_all(out, plan.n_shards):
        committed += seen.whole
        endings += seen.endings
        for stage, seconds in seen.cpu:
            costs.setdefault(stage, []).append(seconds)
    return BuildState(
        total=len(plan.scene_ids),
        committed=committed,
        shards=plan.n_shards,
        fingerprint=run["fingerprint"],
        endings=tuple(endings),
        costs=tuple(_cost(stage, seconds) for stage, seconds in costs.items()),
    )


@dataclass(frozen=True, slots=True)
class _Standing:
    """Shards with a journal, and those that are committed, from one look at each folder, in this order."""

    journals: frozenset[int]
    committed: frozenset[int]


def _standing(out: StoragePath) -> _Standing:
    return _Standing(find_journals(list_names(out / WORK)), committed_shards(out))


@dataclass(frozen=True, slots=True)
class _Shard:
    whole: bool
    endings: list[SceneOutcome]
    cpu: list[tuple[str, float]]


def _look_at_all(out: StoragePath, n_shards: int) -> Iterable[_Shard]:
    """Every shard, in order; in a store several at once, because each means to wait for answers."""
    look = partial(_look_patiently, out, _standing(out))
    if not isinstance(out, UPath):
        return map(look, range(n_shards))
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        return list(threads.map(look, range(n_shards)))


def _look_patiently(out: StoragePath, standing: _Standing, shard: int) -> _Shard:
    for _ in range(_LOOKS):
        try:
            return _look(out, shard, standing)
        except FileNotFoundError:  # the shard was committed while we looked: look again
            standing = _standing(out)
    return _look(out, shard, standing)


def _look(out: StoragePath, shard: int, standing: _Standing) -> _Shard:
    """One shard: what its journal says counts, then what is committed and not taken back.

    Raises:
        FileNotFoundError: if what stood there has gone meanwhile.
    """
    journal = journal_path(out, shard)
    contents = read_journal(journal) if shard in standing.journals else EMPTY_JOURNAL
    whole = shard in standing.committed
    if not whole and shard in standing.journals and not contents.results and is_committed(out, shard):
        raise FileNotFoundError(str(journal))
    endings: list[SceneOutcome] = []
    cpu: list[tuple[str, float]] = []
    for entry in contents.results.values():  # one at a time: each holds all files of its scene
        result = read_result(journal, entry)
        endings.append(_from_result(result, shard))
        cpu += [(timing.stage, timing.cpu_s) for timing in result.timings]
    if whole:
        newer = contents.reopened | set(contents.results)
        rows = _rows(out, "scenes", shard, _COLUMNS)
        endings += [_from_row(row) for row in rows if row["scene_id"] not in newer]
        timings = _rows(out, "timings", shard, ("scene_id", "stage", "cpu_s"))
        cpu += [(row["stage"], row["cpu_s"]) for row in timings if row["scene_id"] not in newer]
    return _Shard(whole and not contents.reopened, endings, cpu)


def _from_result(result: SceneResult, shard: int) -> SceneOutcome:
    why = result.reason or result.error_kind
    return SceneOutcome(result.scene_id, result.status, result.stage, why, result.detail, result.attempts, shard)


def _from_row(row: dict[str, Any]) -> SceneOutcome:
    why = row["reason"] or row["error_kind"] or ""
    return SceneOutcome(
        row["scene_id"], row["status"], row["stage"], why, row["detail"] or "", row["attempts"], row["shard"]
    )


def _rows(out: StoragePath, table: str, shard: int, columns: tuple[str, ...]) -> list[dict[str, Any]]:
    path = shard_path(out, table, shard)
    rows: list[dict[str, Any]] = read_shard(path, columns=columns).to_pylist()
    return rows


def _cost(stage: str, seconds: list[float]) -> StageCost:
    ordered = sorted(seconds)
    p90 = ordered[math.ceil(0.9 * len(ordered)) - 1]
    return StageCost(stage, len(ordered), median(ordered), p90, sum(ordered))
