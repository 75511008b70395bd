"""Repeated reads of a running build: committed shards are read once, of journals only new entries."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field

import pyarrow as pa
import pyarrow.compute as pc

from schemas.work import StageTiming, Status
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.columns import count_groups
from tableverse_factory.dataset.committed_rows import map_parts
from tableverse_factory.dataset.journals import (
    WORK,
    find_journal_end,
    find_journals,
    journal_path,
    read_journal,
    read_result,
)
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.shards import committed_shards, is_committed
from tableverse_factory.rebuild import MANIFEST_STAGE
from tableverse_factory.run_record import read_run
from workers.progress.shard_rows import read_committed_shard
from workers.progress.tally import Tally

_SCENES, _TIMINGS = ("scene_id", "status", "stage"), ("scene_id", "stage", "cpu_s", "wall_s")


@dataclass(frozen=True, slots=True)
class _Scene:
    """A scene of an open shard."""

    status: Status
    stage: str  # the last stage that ran
    timings: tuple[StageTiming, ...]


@dataclass(slots=True)
class _OpenShard:
    """An open shard as far as its journal was read."""

    end: int = 0  # position of the next frame [bytes]
    scenes: dict[str, _Scene] = field(default_factory=dict)  # latest status of each scene
    reopened: set[str] = field(default_factory=set)  # scenes whose committed result is void
    merged: bool = False  # whether `scenes` contains the valid committed results


class BuildFollower:
    """Follower of the build in OUT, which only reads; the cost of a read depends on the changes since the last one."""

    def __init__(self, out: StoragePath) -> None:
        self._out = out
        read_run(out / "run.json")
        plan = read_plan(out / "plan.parquet")
        self._total, self.shards = len(plan.scene_ids), plan.n_shards
        self._whole: set[int] = set()
        self._open: dict[int, _OpenShard] = {}
        self._counted = Tally((MANIFEST_STAGE,), self._total, before=0, shards=self.shards)

    def read_tally(self) -> Tally:
        """Count the scenes; queued and running ones are unknown outside the build."""
        journals, committed = find_journals(list_names(self._out / WORK)), committed_shards(self._out)
        if self._has_reopened(journals):
            self._whole.clear()
            self._counted = Tally((MANIFEST_STAGE,), self._total, before=0, shards=self.shards)
        self._read_committed(committed - journals - self._open.keys() - self._whole)
        for shard in sorted((journals | committed) - self._whole):
            self._read_shard(shard)
        tally = deepcopy(self._counted)
        for open_shard in self._open.values():
            _count_scenes(tally, open_shard.scenes.values())
        tally.committed = len(self._whole)
        return tally

    def _has_reopened(self, journals: frozenset[int]) -> bool:
        """Whether `failures --retry` has reopened shards that were whole."""
        return any(read_journal(journal_path(self._out, shard)).reopened for shard in journals & self._whole)

    def _read_committed(self, shards: Iterable[int]) -> None:
        """Read shards without a journal, many at once; one that is being replaced is left to the next read."""

        def read(part: Sequence[int]) -> tuple[list[int], list[pa.Table]]:
            found: dict[int, Sequence[pa.Table]] = {}
            for shard in part:
                with suppress(FileNotFoundError):
                    found[shard] = read_committed_shard(self._out, shard, _SCENES, _TIMINGS)[:2]
            return [*found], [pa.concat_tables(tables) for tables in zip(*found.values(), strict=True)]

        for part, tables in map_parts(read, self._out, sorted(shards)):
            if part:
                _count_rows(self._counted, *tables)
                self._whole.update(part)

    def _read_shard(self, shard: int) -> None:
        """Read the new entries of a shard; one that is being published is left to the next read."""
        path = journal_path(self._out, shard)
        open_shard = self._open.get(shard)
        if open_shard is None or find_journal_end(path) < open_shard.end:
            open_shard = _OpenShard()
        self._open[shard] = open_shard
        try:
            _read_new(open_shard, path)
            if open_shard.merged or not is_committed(self._out, shard):
                return
            scenes, timings, _ = read_committed_shard(self._out, shard, _SCENES, _TIMINGS)
        except FileNotFoundError:
            return
        if open_shard.reopened:
            open_shard.merged = True
            for scene_id, scene in _make_scenes(scenes, timings).items():
                if scene_id not in open_shard.reopened:
                    open_shard.scenes.setdefault(scene_id, scene)
            return
        _count_rows(self._counted, scenes, timings)
        self._whole.add(shard)
        del self._open[shard]


def _read_new(open_shard: _OpenShard, path: StoragePath) -> None:
    journal = read_journal(path, open_shard.end)
    for scene_id in journal.reopened:
        open_shard.reopened.add(scene_id)
        open_shard.scenes.pop(scene_id, None)
    for scene_id, entry in journal.results.items():
        result = read_result(path, entry)
        open_shard.scenes[scene_id] = _Scene(result.status, result.stage, result.timings)
    open_shard.end = journal.end


def _make_scenes(scenes: pa.Table, timings: pa.Table) -> dict[str, _Scene]:
    times: dict[str, list[StageTiming]] = {}
    for row in timings.to_pylist():
        times.setdefault(row["scene_id"], []).append(StageTiming(row["stage"], row["cpu_s"], row["wall_s"]))
    return {
        row["scene_id"]: _Scene(row["status"], row["stage"], tuple(times.get(row["scene_id"], ())))
        for row in scenes.to_pylist()
    }


def _count_scenes(tally: Tally, scenes: Iterable[_Scene]) -> None:
    stages = dict.fromkeys(tally.stages)
    for scene in scenes:
        tally.ended[scene.stage, scene.status] += 1
        for timing in scene.timings:
            tally.record_call(timing.stage, timing.cpu_s, timing.wall_s)
            tally.passed[timing.stage] += timing.stage != scene.stage
            stages.setdefault(timing.stage)
        stages.setdefault(scene.stage)
    tally.stages = tuple(stages)


def _count_rows(tally: Tally, scenes: pa.Table, timings: pa.Table) -> None:
    """Count the scenes of committed shards."""
    for (stage, status), count in count_groups(scenes, ("stage", "status")).items():
        tally.ended[stage, status] += count
    last = pc.take(scenes["stage"], pc.index_in(timings["scene_id"], scenes["scene_id"]))
    passed = timings.filter(pc.not_equal(timings["stage"], last))
    tally.passed.update({stage: count for (stage,), count in count_groups(passed, ["stage"]).items()})
    ran = timings["stage"].unique().to_pylist()
    for stage in ran:
        own = timings.filter(pc.equal(timings["stage"], stage))
        for durations, name in ((tally.cpu[stage], "cpu_s"), (tally.wall[stage], "wall_s")):
            durations.add_all(own[name].to_numpy())
    tally.stages = tuple(dict.fromkeys((*tally.stages, *ran, *scenes["stage"].unique().to_pylist())))
