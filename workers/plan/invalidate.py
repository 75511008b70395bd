"""Invalidation of scenes: the next build computes them again and rewrites their shards."""

from collections.abc import Collection

from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.journals import WORK, journal_path
from tableverse_factory.dataset.shard_plan import Plan, read_plan
from workers.state.commit import publish_ready
from workers.state.journal import open_journal
from workers.state.lock import LOCK, create_writer_lock


def reopen_scenes(out: StoragePath, scene_ids: Collection[str]) -> int:
    """Reopen scenes, which stay committed until the next build has theirs; returns how many shards it will write."""
    with create_writer_lock(out / WORK / LOCK) as lock:
        publish_ready(out, lock.check)
        return invalidate_scenes(out, read_plan(out / "plan.parquet"), scene_ids)


def invalidate_scenes(out: StoragePath, plan: Plan, scene_ids: Collection[str]) -> int:
    """Invalidate scenes of a locked dataset whose ready shards are published; survives a loss of power."""
    by_shard: dict[int, list[str]] = {}
    for scene_id in scene_ids:
        by_shard.setdefault(plan.shards[plan.rank_of(scene_id)], []).append(scene_id)
    for shard, members in sorted(by_shard.items()):
        journal = open_journal(journal_path(out, shard))
        for scene_id in members:
            journal.reopen(scene_id)
        journal.flush()  # before run.json is written: a power loss must not keep only the latter
        journal.close()
    return len(by_shard)
