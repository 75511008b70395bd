"""Checkpoints of exported scenes, made from their shards for the stages that add to them."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

from upath import UPath

from schemas.manifest import ImageRow
from schemas.scene import ExportedScene
from tableverse_factory.core.framing import FrameError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.committed_scene import load_part
from tableverse_factory.dataset.journals import WORK, find_journals, journal_path, read_results
from tableverse_factory.dataset.shard_plan import Plan
from tableverse_factory.dataset.shards import committed_shards
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore, name_checkpoints

_N_THREADS = 8  # threads for writes into a store, which mostly wait for answers

Fingerprints = Mapping[str, Mapping[str, str]]


def checkpoint_exported_scenes(
    out: StoragePath, plan: Plan, rows: Sequence[ImageRow], fingerprints: Fingerprints, scene_ids: Collection[str]
) -> None:
    """Write a checkpoint of the exported scene for each of these done scenes: one in a shard is named, not copied.

    This precedes the invalidation of the scenes, so a kill in between only leaves valid checkpoints. `out` is locked
    and its ready shards are published; `fingerprints` are of the stages of each kind of row, by its value.
    """
    records, wanted = CheckpointStore(out / CHECKPOINTS), set(scene_ids)
    journals, committed = find_journals(list_names(out / WORK)), committed_shards(out)
    with ThreadPoolExecutor(_N_THREADS if isinstance(out, UPath) else 1) as threads:
        for shard, members in enumerate(plan.members()):
            chosen = [rows[rank] for rank in members if plan.scene_ids[rank] in wanted]
            names = {row.scene_id: name_checkpoints(shard, row, fingerprints[row.kind.value])[-2] for row in chosen}
            newer = set()
            for scene in _read_parts(out, shard, names) if shard in journals else ():
                records.write(names[scene.scene_id], scene)
                newer.add(scene.scene_id)
            known = records.index(shard) if chosen else {}
            named = [i for i, name in names.items() if shard in committed and i not in newer and name not in known]
            list(threads.map(partial(_write_tombstone, records, names), named))


def _write_tombstone(records: CheckpointStore, names: Mapping[str, str], scene_id: str) -> None:
    records.write(names[scene_id], scene_id)


def _read_parts(out: StoragePath, shard: int, scene_ids: Collection[str]) -> Iterator[ExportedScene]:
    """Read done scenes whose latest result is not in a shard yet; one that does not read is computed again."""
    for scene_id, result in read_results(journal_path(out, shard)).items():
        if scene_id in scene_ids and result.part is not None:
            with suppress(FileNotFoundError, FrameError):
                yield load_part(out, shard, scene_id, result.part)
