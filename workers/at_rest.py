"""What a stage that adds to exported scenes takes as its input, where no record of them was kept."""

from collections.abc import Collection, Mapping, Sequence

from schemas.codec import decode, encode
from schemas.manifest import ImageRow
from schemas.scene import ExportedScene
from tableverse_factory.motion_files import without_motions
from tableverse_factory.plan import Plan
from tableverse_factory.shards import committed_shards
from tableverse_factory.storage import Place, names_in
from workers.journal import journal_place, journals_among, read_contents, read_result
from workers.ledger import WORK
from workers.records import AT_REST, RECORDS, Records, record_names

Fingerprints = Mapping[str, Mapping[str, str]]


def keep_exported(
    out: Place, plan: Plan, rows: Sequence[ImageRow], fingerprints: Fingerprints, scene_ids: Collection[str]
) -> None:
    """Writes a record of what was exported for each of these done scenes: what is in a shard is named, not copied.

    It comes before they are taken back, so a kill in between only leaves records that are right.

    Args:
        out: The dataset, locked; what was ready is published.
        plan: Of the build.
        rows: Of the manifest, in the plan's order.
        fingerprints: Of the stages of each kind of row, by its value.
        scene_ids: Whose ending counts now and is `done`.

    Raises:
        BuildError: if the disk or the store refuses.
    """
    records, wanted = Records(out / RECORDS), set(scene_ids)
    journals, committed = journals_among(names_in(out / WORK)), committed_shards(out)
    for shard, members in enumerate(plan.members()):
        chosen = [rows[rank] for rank in members if plan.scene_ids[rank] in wanted]
        if not chosen:
            continue
        known = records.index(shard)
        journal = journal_place(out / WORK, shard)
        results = read_contents(journal).results if shard in journals else {}
        for row in chosen:
            name = record_names(shard, row, fingerprints[row.kind.value])[-2]
            if row.scene_id in results:
                result = read_result(journal, results[row.scene_id])
                if result.exported is not None:
                    records.write(name, encode(_as_exported(decode(result.exported))))
            elif shard in committed and name not in known:
                records.write(name, AT_REST + row.scene_id.encode())
    records.close()


def _as_exported(scene: ExportedScene) -> ExportedScene:
    files = without_motions(scene.files)
    return ExportedScene(scene.scene_id, files, scene.certificate, scene.scene_row, scene.object_rows, scene.task_rows)
