"""Progress of a build: journals of open shards, committed shards, and the step between them."""

import secrets
from collections.abc import Callable, Collection, Sequence

from schemas.work import CommitCall, SceneResult, StagedShard
from tableverse_factory.core.storage.files import StoragePath, list_names, redact_uri, remove_folder
from tableverse_factory.dataset.integrity import check_files, check_tars
from tableverse_factory.dataset.journals import WORK, find_journals, journal_path, read_journal
from tableverse_factory.dataset.parts import find_parts, parts_folder
from tableverse_factory.dataset.shard_plan import Plan
from tableverse_factory.dataset.shards import committed_shards
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore
from workers.state.commit import discard_staged, publish_ready, publish_shard, stage_shard
from workers.state.journal import Journal, open_journal


class Ledger:
    """Record of every scene of the plan, which is either pending, in its shard's journal, or committed.

    Needs the writer lock. A result is safe from kills when `record` returns.
    """

    def __init__(
        self,
        out: StoragePath,
        plan: Plan,
        guard: Callable[[], None] = lambda: None,
        post_export: Collection[str] = (),
        keep: bool = True,
    ) -> None:
        """Repair what a kill left, and commit shards that were complete.

        `guard` is called before anything is written and raises if this process is no longer the writer; `post_export`
        names the stages that add to exported scenes; `keep` says whether the checkpoints of a shard outlive its commit.
        """
        self._out, self._plan, self._guard, self._post_export = out, plan, guard, tuple(post_export)
        self._keep = keep
        self.bytes_committed = 0  # of the shards that were written here
        self.damaged: list[str] = []  # a message for each journal or part that cannot be read
        self._members = plan.members()
        self._journals: dict[int, Journal] = {}
        publish_ready(out, guard)
        committed, names = committed_shards(out), list_names(out / WORK)
        journals = find_journals(names)
        check_files(out, committed)
        check_tars(out, committed)
        self._missing: dict[int, set[str] | None] = {  # None for all scenes of the shard
            shard: None for shard in range(plan.n_shards) if shard not in committed
        }
        for shard in sorted(find_parts(names) - journals):
            remove_folder(parts_folder(out, shard))
        for shard in sorted(journals):
            self._open(shard, shard in committed)

    def todo(self) -> list[int]:
        """List the ranks of the pending scenes, in the plan's order."""
        return [
            rank
            for shard, missing in sorted(self._missing.items())
            for rank in self._members[shard]
            if missing is None or self._plan.scene_ids[rank] in missing
        ]

    @property
    def committed(self) -> int:
        """Number of committed shards."""
        return self._plan.n_shards - len(self._missing)

    def record(self, rank: int, result: SceneResult) -> CommitCall | None:
        """Record the result of the scene at `rank`; returns the call that stages its shard if it was the last one."""
        shard = int(self._plan.shards[rank])
        self._guard()
        if shard not in self._journals:
            self._journals[shard] = open_journal(journal_path(self._out, shard))
        self._journals[shard].record(result)
        missing = self._missing[shard]
        if missing is None:
            missing = self._missing[shard] = set(self._list_members(shard))
        missing.discard(result.scene_id)
        return None if missing else self._make_call(shard)

    def publish(self, call: CommitCall, staged: StagedShard) -> list[int]:
        """Publish a staged shard; or, if parts of it do not read, return the ranks of scenes to compute again."""
        if staged.damaged:
            return self._reopen(call.shard, staged.damaged)
        publish_shard(self._out, call.shard, staged, self._guard)
        self._remove_work(call.shard, self._journals.pop(call.shard))
        del self._missing[call.shard]
        self.bytes_committed += staged.size
        return []

    def retry(self, call: CommitCall) -> CommitCall:
        """Make the call again whose worker was lost."""
        discard_staged(self._out, call)
        return self._make_call(call.shard)

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

    def _remove_work(self, shard: int, journal: Journal) -> None:
        """Remove what a committed shard needs no more."""
        if not self._keep:  # before the journal, by which a restart finds them
            CheckpointStore(self._out / CHECKPOINTS).delete(shard)
        journal.remove()
        remove_folder(parts_folder(self._out, shard))

    def _make_call(self, shard: int) -> CommitCall:
        self._journals[shard].flush()
        return CommitCall(shard, tuple(self._list_members(shard)), self._post_export, secrets.token_hex(8))

    def _list_members(self, shard: int) -> list[str]:
        return [str(self._plan.scene_ids[rank]) for rank in self._members[shard]]

    def _open(self, shard: int, committed: bool) -> None:
        path = journal_path(self._out, shard)
        state = read_journal(path)
        if state.lost:
            self.damaged.append(
                f"{redact_uri(str(path))}: {state.lost} bytes hold no whole result, as after a kill or on a failing "
                "disk: scenes whose results stood there are computed again"
            )
        if committed and not state.reopened:  # a kill came between the commit and this
            self._remove_work(shard, open_journal(path))
            return
        self._missing[shard] = {*(state.reopened if committed else self._list_members(shard))} - set(state.results)
        if not self._missing[shard]:
            self._journals[shard] = open_journal(path)
            call = self._make_call(shard)
            self.publish(call, stage_shard(self._out, call))

    def _reopen(self, shard: int, scene_ids: Sequence[str]) -> list[int]:
        """Take back results whose parts do not read, as after a loss of power."""
        self._guard()
        for scene_id in scene_ids:
            self._journals[shard].reopen(scene_id)
        missing = self._missing[shard] = set(scene_ids)
        self.damaged.append(
            f"shard {shard}: {len(scene_ids)} finished scenes do not read, as after a loss of power or on a failing "
            f"disk ({', '.join(scene_ids[:3])}): they are computed again"
        )
        return [rank for rank in self._members[shard] if self._plan.scene_ids[rank] in missing]
