"""Taking scenes back, so that the next build computes them again and writes their shards anew."""

from collections.abc import Collection

from tableverse_factory.plan import Plan, read_plan
from tableverse_factory.storage import Place
from workers.journal import open_journal
from workers.ledger import WORK, journal_path
from workers.lock import LOCK, writer_lock


def reopen(out: Place, scene_ids: Collection[str]) -> int:
    """Takes scenes back; the committed shards stay as they are until the next build has all of their scenes again.

    Returns:
        How many shards the next build will write.

    Raises:
        BuildError: if there is no build, or another process is writing it.
    """
    with writer_lock(out / WORK / LOCK):
        return take_back(out, read_plan(out / "plan.parquet"), scene_ids)


def take_back(out: Place, plan: Plan, scene_ids: Collection[str]) -> int:
    """The same, for one who holds the lock.

    Raises:
        BuildError: if the disk refuses.
    """
    shard_of = dict(zip(plan.scene_ids, plan.shards, strict=True))
    by_shard: dict[int, list[str]] = {}
    for scene_id in scene_ids:
        by_shard.setdefault(shard_of[scene_id], []).append(scene_id)
    for shard, members in sorted(by_shard.items()):
        journal = open_journal(journal_path(out, shard))
        for scene_id in members:
            journal.reopen(scene_id)
        journal.close()
    return len(by_shard)
