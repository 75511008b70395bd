"""Repeated reads of a running build: committed shards are read once, of journals only new entries."""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field

from tableverse_factory.core.storage.files import StoragePath, list_names
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
from workers.progress.build_state import SceneStatus, make_scene_status, read_committed_scenes
from workers.progress.tally import Tally


@dataclass(slots=True)
class _OpenShard:
    """An open shard as far as its journal was read."""

    end: int = 0  # position of the next frame [bytes]
    scenes: dict[str, SceneStatus] = field(default_factory=dict)  # latest status of each scene
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
        journals = find_journals(list_names(self._out / WORK))
        if self._has_reopened(journals):
            self._whole.clear()
            self._counted = Tally((MANIFEST_STAGE,), self._total, before=0, shards=self.shards)
        for shard in sorted((journals | committed_shards(self._out)) - self._whole):
            self._read_shard(shard)
        tally = deepcopy(self._counted)
        for open_shard in self._open.values():
            _count(tally, open_shard.scenes.values())
        tally.committed = len(self._whole)
        return tally

    def _has_reopened(self, journals: frozenset[int]) -> bool:
        """Whether `failures --retry` has reopened shards that were whole."""
        return any(read_journal(journal_path(self._out, shard)).reopened for shard in journals & self._whole)

    def _read_shard(self, shard: int) -> None:
        """Read the new entries of a shard; one that is being published is left to the next read."""
        path = journal_path(self._out, shard)
        open_shard = self._open.get(shard)
        if open_shard is None or find_journal_end(path) < open_shard.end:
            open_shard = _OpenShard()
        self._open[shard] = open_shard
        try:
            _read_new(open_shard, path, shard)
            if open_shard.merged or not is_committed(self._out, shard):
                return
            scenes = read_committed_scenes(self._out, shard)
        except FileNotFoundError:
            return
        if open_shard.reopened:
            open_shard.merged = True
            for scene_id in scenes.keys() - open_shard.reopened:
                open_shard.scenes.setdefault(scene_id, scenes[scene_id])
            return
        _count(self._counted, scenes.values())
        self._whole.add(shard)
        del self._open[shard]


def _read_new(open_shard: _OpenShard, path: StoragePath, shard: int) -> None:
    journal = read_journal(path, open_shard.end)
    for scene_id in journal.reopened:
        open_shard.reopened.add(scene_id)
        open_shard.scenes.pop(scene_id, None)
    for scene_id, entry in journal.results.items():
        open_shard.scenes[scene_id] = make_scene_status(read_result(path, entry), shard)
    open_shard.end = journal.end


def _count(tally: Tally, scenes: Iterable[SceneStatus]) -> None:
    stages = dict.fromkeys(tally.stages)
    for scene in scenes:
        tally.ended[scene.stage, scene.status] += 1
        for stage, cpu_s, wall_s in scene.timings:
            tally.record_call(stage, cpu_s, wall_s)
            tally.passed[stage] += stage != scene.stage
            stages.setdefault(stage)
        stages.setdefault(scene.stage)
    tally.stages = tuple(stages)
