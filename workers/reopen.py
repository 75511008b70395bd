"""Taking scenes back, so that the next build computes them again and writes their shards anew."""

from collections.abc import Collection
from pathlib import Path

from tableverse_factory.plan import Plan, read_plan
from workers.journal import Journal
from workers.ledger import WORK, journal_path
from workers.lock import WriterLock


def reopen(out: Path, scene_ids: Collection[str]) -> int:
    """Takes scenes back; the committed shards stay as they are until the next build has all of their scenes again.

    Returns:
        How many shards the next build will write.

    Raises:
        BuildError: if there is no build, or another process is writing it.
    """
    with WriterLock(out / WORK / "lock"):
        return take_back(out, read_plan(out / "plan.parquet"), scene_ids)


def take_back(out: Path, plan: Plan, scene_ids: Collection[str]) -> int:
    """The same, for one who holds the lock.

    Raises:
        BuildError: if the disk refuses.
    """
    shard_of = dict(zip(plan.scene_ids, plan.shards, strict=True))
    by_shard: dict[int, list[str]] = {}
    for scene_id in scene_ids:
        by_shard.setdefault(shard_of[scene_id], []).append(scene_id)
    for shard, members in sorted(by_shard.items()):
        journal = Journal(journal_path(out, shard))
        for scene_id in members:
            journal.reopen(scene_id)
        journal.close()
    return len(by_shard)
