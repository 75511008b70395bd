"""Progress of a build: journals of open shards, committed shards, and the step between them."""

from collections.abc import Callable, Mapping, Sequence

from schemas.manifest import ImageRow
from schemas.work import SceneResult
from tableverse_factory.core.storage.files import StoragePath, list_names, redact_uri
from tableverse_factory.dataset.integrity import check_files, check_tars
from tableverse_factory.dataset.shard_plan import Plan
from tableverse_factory.dataset.shards import committed_shards, shard_stem
from workers.state.commit import commit_shard, publish_ready
from workers.state.journal import SUFFIX, find_journals, open_journal, read_journal
from workers.state.journal_frames import Journal

WORK = ".work"


class Ledger:
    """Record of every scene of the plan, which is either pending, in its shard's journal, or committed.

    Needs the writer lock. A result is safe from kills when `record` returns.
    """

    def __init__(
        self,
        out: StoragePath,
        plan: Plan,
        rows: Sequence[ImageRow],
        guard: Callable[[], None] = lambda: None,
        post_export: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """Repair what a kill left, and commit shards that were complete; `rows` are in the plan's order.

        `guard` is called before anything is written and raises if this process is no longer the writer; `post_export`
        has the tables that each post-export stage writes.
        """
        self._guard, self._post_export = guard, post_export or {}
        self.bytes_committed = 0  # of the shards that were written here
        self.damaged: list[str] = []  # a message for each journal that cannot be read in part
        self._out, self._work = out, out / WORK
        self._plan, self._rows, self._members = plan, rows, plan.members()
        self._ranks = {scene_id: rank for rank, scene_id in enumerate(plan.scene_ids)}
        self._journals: dict[int, Journal] = {}
        self._missing: dict[int, set[str]] = {}
        publish_ready(out, self._work, guard)
        committed, journals = committed_shards(out), find_journals(list_names(self._work))
        check_files(out, committed)
        check_tars(out, committed)
        for shard in range(plan.n_shards):
            if shard not in committed or shard in journals:
                self._open(shard, shard in committed, shard in journals)

    def todo(self) -> list[int]:
        """List the ranks of the pending scenes, in the plan's order."""
        return sorted(self._ranks[scene_id] for missing in self._missing.values() for scene_id in missing)

    def shard_of(self, scene_id: str) -> int:
        """Return the scene's shard."""
        return self._plan.shards[self._ranks[scene_id]]

    @property
    def committed(self) -> int:
        """Number of committed shards."""
        return self._plan.n_shards - len(self._missing)

    def record(self, result: SceneResult) -> bool:
        """Record a scene's result, and commit its shard if it was the last one missing."""
        shard = self.shard_of(result.scene_id)
        self._guard()
        if shard not in self._journals:
            self._journals[shard] = open_journal(journal_path(self._out, shard))
        self._journals[shard].record(result)
        self._missing[shard].discard(result.scene_id)
        complete = not self._missing[shard]
        if complete:
            self._commit(shard)
        return complete

    def tick(self) -> None:
        """Write results that have waited long enough; called several times a second."""
        self._guard()
        for journal in self._journals.values():
            journal.tick()

    def close(self) -> None:
        """Close the journals, which stay."""
        self._guard()
        for journal in self._journals.values():
            journal.close()
        self._journals.clear()

    def _open(self, shard: int, committed: bool, has_journal: bool) -> None:
        members = {self._plan.scene_ids[rank] for rank in self._members[shard]}
        if not has_journal:
            self._missing[shard] = members
            return
        path = journal_path(self._out, shard)
        state = read_journal(path)
        if state.lost:
            self.damaged.append(
                f"{redact_uri(str(path))}: {state.lost} bytes hold no whole result, as after a kill or on a failing "
                "disk: scenes whose results stood there are computed again"
            )
        if committed and not state.reopened:
            open_journal(path).remove()  # a kill came between the commit and this
            return
        self._missing[shard] = (set(state.reopened) if committed else members) - set(state.results)
        if not self._missing[shard]:
            self._journals[shard] = open_journal(path)
            self._commit(shard)

    def _commit(self, shard: int) -> None:
        journal = self._journals[shard]
        rows = [self._rows[rank] for rank in self._members[shard]]

        def read_result(scene_id: str) -> SceneResult | None:
            return journal.read(scene_id) if scene_id in journal.results else None

        self.bytes_committed += commit_shard(
            self._out, self._work, shard, rows, read_result, self._guard, self._post_export
        )
        journal.remove()
        del self._missing[shard], self._journals[shard]


def journal_path(out: StoragePath, shard: int) -> StoragePath:
    """Path of the journal of an open shard."""
    return out / WORK / f"{shard_stem(shard)}{SUFFIX}"
