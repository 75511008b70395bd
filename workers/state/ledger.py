"""What is accounted for and what is not: journals of open shards, committed shards, and the step between them."""

from collections.abc import Callable, Sequence

from schemas.manifest import ImageRow
from schemas.work import SceneResult
from tableverse_factory.core.storage.files import StoragePath, list_names, redact_uri
from tableverse_factory.dataset.integrity import check_files, check_tars
from tableverse_factory.dataset.shard_plan import Plan
from tableverse_factory.dataset.shards import committed_shards
from workers.state.commit import commit_shard, publish_ready
from workers.state.journal import Journal, journal_place, journals_among, open_journal, read_contents

WORK = ".work"


class Ledger:
    """Every scene of the plan is in exactly one place: still to do, in its shard's journal, or committed.

    Needs the writer lock. A result is safe from kills when `record` returns.

    Attributes:
        bytes_committed: Of the shards that were written here.
        damaged: A line for each journal of which something cannot be read.
    """

    def __init__(
        self, out: StoragePath, plan: Plan, rows: Sequence[ImageRow], guard: Callable[[], None] = lambda: None
    ) -> None:
        """Repairs what a kill left, and commits shards whose last scene was the last thing to happen.

        Args:
            out: The dataset.
            plan: Of the build.
            rows: Of the manifest, in the plan's order.
            guard: Called before anything is written; raises where this process is no longer the writer.

        Raises:
            BuildError: if the disk is full, it or the store refuses, or a committed shard has lost a file.
        """
        self._guard = guard
        self.bytes_committed = 0
        self.damaged: list[str] = []
        self._out, self._work = out, out / WORK
        self._plan, self._rows, self._members = plan, rows, plan.members()
        self._ranks = {scene_id: rank for rank, scene_id in enumerate(plan.scene_ids)}
        self._journals: dict[int, Journal] = {}
        self._missing: dict[int, set[str]] = {}
        publish_ready(out, self._work, guard)
        committed, journals = committed_shards(out), journals_among(list_names(self._work))
        check_files(out, committed)
        check_tars(out, committed)
        for shard in range(plan.n_shards):
            if shard not in committed or shard in journals:
                self._open(shard, shard in committed, shard in journals)

    def todo(self) -> list[int]:
        """Ranks of the scenes that are not accounted for, in the plan's order."""
        return sorted(self._ranks[scene_id] for missing in self._missing.values() for scene_id in missing)

    def shard_of(self, scene_id: str) -> int:
        """Where the scene stands."""
        return self._plan.shards[self._ranks[scene_id]]

    @property
    def committed(self) -> int:
        """How many shards are whole."""
        return self._plan.n_shards - len(self._missing)

    def record(self, result: SceneResult) -> bool:
        """Accounts for a scene, and commits its shard when it was the last one missing.

        Returns:
            Whether its shard is whole now.

        Raises:
            BuildError: if the disk is full or refuses; nothing recorded earlier is lost.
        """
        shard = self.shard_of(result.scene_id)
        self._guard()
        if shard not in self._journals:
            self._journals[shard] = open_journal(journal_path(self._out, shard))
        self._journals[shard].record(result)
        self._missing[shard].discard(result.scene_id)
        whole = not self._missing[shard]
        if whole:
            self._commit(shard)
        return whole

    def tick(self) -> None:
        """Called several times a second: results that wait to be written are not kept waiting longer.

        Raises:
            BuildError: as `record`.
        """
        self._guard()
        for journal in self._journals.values():
            journal.tick()

    def close(self) -> None:
        """Closes the journals; what they hold stays.

        Raises:
            BuildError: as `record`.
        """
        self._guard()
        for journal in self._journals.values():
            journal.close()
        self._journals.clear()

    def _open(self, shard: int, committed: bool, begun: bool) -> None:
        members = {self._plan.scene_ids[rank] for rank in self._members[shard]}
        if not begun:
            self._missing[shard] = members
            return
        path = journal_path(self._out, shard)
        contents = read_contents(path)
        if contents.lost:
            self.damaged.append(
                f"{redact_uri(str(path))}: {contents.lost} bytes hold no whole result, as after a kill or on a failing "
                "disk: scenes whose results stood there are computed again"
            )
        if committed and not contents.reopened:
            open_journal(path).remove()  # a kill came between the commit and this
            return
        self._missing[shard] = (set(contents.reopened) if committed else members) - set(contents.results)
        if not self._missing[shard]:
            self._journals[shard] = open_journal(path)
            self._commit(shard)

    def _commit(self, shard: int) -> None:
        journal = self._journals[shard]
        rows = [self._rows[rank] for rank in self._members[shard]]

        def result_of(scene_id: str) -> SceneResult | None:
            return journal.read(scene_id) if scene_id in journal.results else None

        self.bytes_committed += commit_shard(self._out, self._work, shard, rows, result_of, self._guard)
        journal.remove()
        del self._missing[shard], self._journals[shard]


def journal_path(out: StoragePath, shard: int) -> StoragePath:
    """Where the results of an open shard are kept."""
    return journal_place(out / WORK, shard)
