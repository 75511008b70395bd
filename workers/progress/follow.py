"""Looking at a build again and again from outside: what is committed is read once, of a journal only what is new."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.shards import committed_shards, is_committed
from tableverse_factory.run_record import read_run
from workers.progress.scene_status import SceneStatus, make_scene_status, read_committed_scenes
from workers.progress.tally import Tally
from workers.state.journal import find_journal_end, find_journals, read_journal, read_result
from workers.state.ledger import WORK, journal_path

MANIFEST_STAGE = "manifest"


@dataclass(slots=True)
class _OpenShard:
    """A journal as far as it was read.

    Attributes:
        end: Where the next frame begins [bytes].
        scenes: The latest result of each scene.
        reopened: Scenes whose committed result no longer counts.
        merged: Whether `scenes` has the committed results that still count.
    """

    end: int = 0
    scenes: dict[str, SceneStatus] = field(default_factory=dict)
    reopened: set[str] = field(default_factory=set)
    merged: bool = False


class BuildFollower:
    """Follows the build in OUT without disturbing it.

    A committed shard is read once and then only counted, so that a look at a large dataset costs what has changed.

    Attributes:
        shards: Of the plan.
    """

    def __init__(self, out: StoragePath) -> None:
        """Reads the plan.

        Raises:
            BuildError: if there is no build.
        """
        self._out = out
        read_run(out / "run.json")
        plan = read_plan(out / "plan.parquet")
        self._total, self.shards = len(plan.scene_ids), plan.n_shards
        self._whole: set[int] = set()
        self._open: dict[int, _OpenShard] = {}
        self._counted = Tally((MANIFEST_STAGE,), self._total, before=0, shards=self.shards)

    def look(self) -> Tally:
        """Where the build stands now; nobody outside knows what waits and what runs.

        Raises:
            BuildError: if a table is damaged.
        """
        journals = find_journals(list_names(self._out / WORK))
        if self._reopened(journals):
            self._whole.clear()
            self._counted = Tally((MANIFEST_STAGE,), self._total, before=0, shards=self.shards)
        for shard in sorted((journals | committed_shards(self._out)) - self._whole):
            self._look_at(shard)
        tally = self._copy()
        for seen in self._open.values():
            _count(tally, seen.scenes.values())
        tally.committed = len(self._whole)
        return tally

    def _reopened(self, journals: frozenset[int]) -> bool:
        """Whether `failures --retry` has opened shards again that were whole."""
        return any(read_journal(journal_path(self._out, shard)).reopened for shard in journals & self._whole)

    def _look_at(self, shard: int) -> None:
        """Reads what is new of a shard; one that is being moved into place just now is looked at the next time."""
        path = journal_path(self._out, shard)
        seen = self._open.get(shard)
        if seen is None or find_journal_end(path) < seen.end:
            seen = _OpenShard()
        self._open[shard] = seen
        try:
            _read_on(seen, path)
            if seen.merged or not is_committed(self._out, shard):
                return
            scenes = read_committed_scenes(self._out, shard)
        except FileNotFoundError:
            return
        if seen.reopened:
            seen.merged = True
            for scene_id in scenes.keys() - seen.reopened:
                seen.scenes.setdefault(scene_id, scenes[scene_id])
            return
        _count(self._counted, scenes.values())
        self._whole.add(shard)
        del self._open[shard]

    def _copy(self) -> Tally:
        """A tally that begins with what the committed shards add up to."""
        counted = self._counted
        tally = Tally(counted.stages, self._total, before=0, shards=self.shards)
        tally.passed, tally.ended = Counter(counted.passed), Counter(counted.ended)
        for ours, theirs in ((tally.wall, counted.wall), (tally.cpu, counted.cpu)):
            for stage, durations in theirs.items():
                ours[stage].buckets, ours[stage].total_s = list(durations.buckets), durations.total_s
        return tally


def _read_on(seen: _OpenShard, path: StoragePath) -> None:
    contents = read_journal(path, seen.end)
    for scene_id in contents.reopened:
        seen.reopened.add(scene_id)
        seen.scenes.pop(scene_id, None)
    for scene_id, entry in contents.results.items():
        seen.scenes[scene_id] = make_scene_status(read_result(path, entry))
    seen.end = contents.end


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
