"""Recomputation from a stage on: stages that a change of the configuration affects, and the scenes to recompute."""

import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from schemas.identity import content_hash
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, read_whole, remove, write_atomic
from tableverse_factory.dataset.journals import WORK
from tableverse_factory.dataset.shard_plan import Plan
from tableverse_factory.run_record import AFTERWARDS, CODE, map_parts_to_stages
from tableverse_factory.stage import Pipelines, Stage
from workers.state.checkpoint_store import CheckpointStore

MARKER = "again.json"  # names the stage and the build, from the invalidation until the build is complete
_STAGE_PLACEHOLDER = "STAGE"


def find_first_affected_stage(stages: Sequence[Stage], differing: Collection[str]) -> int | None:
    """Find the position of the first stage that differing keys of run.json affect, such as `config.settle.max_time_s`.

    The number of stages if none is affected; None if the whole dataset is: by another seed, manifest or version of a
    package. Our own code counts as affecting none: its user decides.
    """
    affected = [len(stages)]
    for key in differing:
        readers = _find_readers(stages, key)
        if readers is None:
            return None
        affected += readers
    return min(affected)


def _find_readers(stages: Sequence[Stage], key: str) -> list[int] | None:
    """Find the positions of the stages that read the value at `key`; None if it affects the whole build."""
    if key == CODE:
        return []
    top, _, rest = key.partition(".")
    if top == AFTERWARDS:
        return [position for position, stage in enumerate(stages) if stage.is_post_export]
    if top in (parts := map_parts_to_stages()):
        return [position for position, stage in enumerate(stages) if stage.name == parts[top]]
    section, _, name = rest.partition(".")
    if top != "config" or section == "run":
        return None
    if name == "deadline_s":
        return [position for position, stage in enumerate(stages) if stage.section == section]
    return [position for position, stage in enumerate(stages) if {section, rest} & set(stage.reads)]


def find_restart_points(pipelines: Pipelines, kinds: Collection[str], section: str) -> dict[str, int]:
    """Find the first stage to recompute of each kind of scene, for `--from SECTION`."""
    used = {kind.value: stages for kind, stages in pipelines.items() if kind.value in kinds}
    points = {
        kind: [position for position, stage in enumerate(stages) if section in (stage.section, stage.name)]
        for kind, stages in used.items()
    }
    if missing := [kind for kind, found in points.items() if not found]:
        known = dict.fromkeys(stage.section for kind in missing for stage in used[kind])
        raise BuildError(f"--from {section[:80]!r}: no such stage for a {missing[0]}; there are {', '.join(known)}")
    return {kind: found[0] for kind, found in points.items()}


def _list_restarts(pipelines: Pipelines, points: Mapping[str, int]) -> list[tuple[str, Sequence[Stage], int]]:
    return [(kind.value, stages, points[kind.value]) for kind, stages in pipelines.items() if kind.value in points]


def is_append_only(pipelines: Pipelines, points: Mapping[str, int]) -> bool:
    """Whether all pipelines restart at a stage that adds to exported scenes, which are then its input."""
    return all(stages[point].is_post_export for _, stages, point in _list_restarts(pipelines, points))


def suggest_restart_stage(pipelines: Pipelines, kinds: Collection[str], differing: Collection[str]) -> str:
    """Suggest the stage to restart from; a placeholder if only code differs, nothing if no restart helps."""
    firsts = []
    for kind, stages in pipelines.items():
        if kind.value in kinds:
            position = find_first_affected_stage(stages, differing)
            if position is None:
                return ""
            firsts.append((len(stages) - position, stages[position].section if position < len(stages) else ""))
    earliest = max(firsts)[1] if firsts else ""
    return earliest or (_STAGE_PLACEHOLDER if CODE in differing else "")


def check_upstream_unchanged(
    pipelines: Pipelines, points: Mapping[str, int], differing: Collection[str], section: str, suggestion: str
) -> None:
    """Refuse to keep outputs of stages that a change affects; `suggestion` is the earliest, or empty for all."""
    for _, stages, point in _list_restarts(pipelines, points):
        position = find_first_affected_stage(stages, differing)
        if position is None:
            raise BuildError(
                f"{', '.join(sorted(differing)[:4])} changed, which no --from can make good: give another OUT"
            )
        if position < point:
            raise BuildError(
                f"{', '.join(sorted(differing)[:4])} changed, which {stages[position].name} reads already: "
                f"give --from {suggestion} instead of --from {section}, or another OUT"
            )


def list_scenes_to_recompute(
    plan: Plan, pipelines: Pipelines, points: Mapping[str, int], scenes: pa.Table
) -> list[str]:
    """List the ids of the scenes that are done, or ended at one of the stages to recompute."""
    ranks = pc.index_in(scenes["scene_id"], plan.scene_ids.values)
    kinds = pc.take(plan.kinds.values, ranks)
    wanted = pc.equal(scenes["status"], "done")
    for kind, stages, point in _list_restarts(pipelines, points):
        again = pc.is_in(scenes["stage"], pa.array([stage.name for stage in stages[point:]], pa.string()))
        wanted = pc.or_(wanted, pc.and_(pc.equal(kinds, kind), again))
    ids: list[str] = scenes["scene_id"].filter(wanted).to_pylist()
    return ids


def delete_checkpoints(records: CheckpointStore, plan: Plan, pipelines: Pipelines, points: Mapping[str, int]) -> None:
    """Delete the checkpoints of the stages to recompute."""
    again = {stage.name for _, stages, point in _list_restarts(pipelines, points) for stage in stages[point:]}
    for shard in range(plan.n_shards):
        records.delete(shard, again)


def write_rerun_marker(out: StoragePath, section: str, record: Mapping[str, Any]) -> None:
    """Write the marker that the scenes are invalidated for this run.json: the same command resumes from here."""
    write_atomic(out / WORK / MARKER, _encode_marker(section, record))


def is_rerun_under_way(out: StoragePath, section: str, record: Mapping[str, Any]) -> bool:
    """Whether this recomputation was started and no other came after it."""
    try:
        return read_whole(out / WORK / MARKER) == _encode_marker(section, record)
    except FileNotFoundError:
        return False


def read_rerun_stage(out: StoragePath) -> str:
    """Read the first stage of the recomputation under way; empty if there is none."""
    try:
        return str(json.loads(read_whole(out / WORK / MARKER))["from"])
    except FileNotFoundError:
        return ""
    except (ValueError, KeyError, TypeError) as error:
        raise BuildError(f"{out / WORK / MARKER} is damaged; repeat the last command to write it anew") from error


def clear_rerun_marker(out: StoragePath) -> None:
    """Delete the marker before scenes are invalidated, so that it never belongs to another run.json."""
    remove(out / WORK / MARKER)


def _encode_marker(section: str, record: Mapping[str, Any]) -> bytes:
    run = content_hash(json.dumps(record, sort_keys=True).encode())
    return (json.dumps({"from": section, "run_sha256": run}) + "\n").encode()
