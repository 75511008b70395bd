"""Description of how a manifest differs from the one that a build began with."""

from collections.abc import Sequence
from contextlib import suppress

from schemas.manifest import ImageRow
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.core.text import pluralize
from tableverse_factory.dataset.journals import WORK, find_journals, journal_path, read_results
from tableverse_factory.dataset.shard_plan import Plan, read_plan
from tableverse_factory.dataset.shards import committed_shards
from tableverse_factory.rebuild import read_manifest_rows


def describe_manifest_change(out: StoragePath, plan: Plan, rows: Sequence[ImageRow]) -> str:
    """Describe in words how these rows, planned so, differ from those that the build in `out` began with.

    The former rows are known of the scenes that are accounted for.
    """
    began = read_plan(out / "plan.parquet")
    old, new = set(began.scene_ids), set(plan.scene_ids)
    if old != new:
        both = len(old & new)
        return f"its manifest has {pluralize(len(old), 'scene')} and this one {len(new)}, with {both} in both"
    if began.scene_ids != plan.scene_ids:
        return "its manifest has the same scenes in another order"
    where = ""
    with suppress(BuildError, OSError):  # what cannot be read is named by a build that may go on
        where = _find_changed_scene(out, began, rows)
    return f"its manifest has the same scenes with other values{where or ', such as where they lie'}"


def _find_changed_scene(out: StoragePath, began: Plan, rows: Sequence[ImageRow]) -> str:
    """Find the first scene whose row is another one now, with the columns that differ; empty if none is known."""
    journals, committed = find_journals(list_names(out / WORK)), committed_shards(out)
    for shard, ranks in enumerate(began.members()):
        if shard not in journals | committed:
            continue
        known = {row.scene_id: row for row in read_manifest_rows(out, shard)} if shard in committed else {}
        results = read_results(journal_path(out, shard)) if shard in journals else {}
        known |= {scene_id: result.row for scene_id, result in results.items()}
        for row in rows[ranks.start : ranks.stop]:
            if columns := _diff_rows(known.get(row.scene_id, row), row):
                return f" of {', '.join(columns)}, first in {row.scene_id}"
    return ""


def _diff_rows(before: ImageRow, now: ImageRow) -> list[str]:
    return [name for name in ImageRow.model_fields if getattr(before, name) != getattr(now, name)]
