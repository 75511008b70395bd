"""Computing again from a stage on: what a change of the configuration touches, and taking back what came of it."""

import json
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from schemas.identity import content_hash
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, read_whole, remove, write_atomic
from tableverse_factory.dataset.shard_plan import Plan
from tableverse_factory.run_record import AFTERWARDS, CODE, map_parts_to_stages
from tableverse_factory.stage import Pipelines, Stage
from workers.progress.build_state import SceneStatus
from workers.state.checkpoint_store import CheckpointStore
from workers.state.ledger import WORK

MARKER = "again.json"
"""In the folder of the work, from when all is taken back until the build is complete: which stage, which build."""

_STAGE_PLACEHOLDER = "STAGE"


def find_first_affected_stage(line: Sequence[Stage], differing: Collection[str]) -> int | None:
    """Position of the first stage of a line for which these keys of run.json make a difference.

    Args:
        line: The stages.
        differing: Dotted keys, such as `config.settle.max_time_s`.

    Returns:
        The position; the line's length where it makes none; None where it is not for a stage to say: another seed,
        another manifest or other versions make another dataset. Of our own code only its user can say what it touches.
    """
    touched = [len(line)]
    for key in differing:
        readers = _find_readers(line, key)
        if readers is None:
            return None
        touched += readers
    return min(touched)


def _find_readers(line: Sequence[Stage], key: str) -> list[int] | None:
    """Positions of the stages that read the value at `key`; None where it concerns the build as a whole."""
    if key == CODE:
        return []
    top, _, rest = key.partition(".")
    if top == AFTERWARDS:
        return [position for position, stage in enumerate(line) if stage.is_post_export]
    if top in (parts := map_parts_to_stages()):
        return [position for position, stage in enumerate(line) if stage.name == parts[top]]
    section, _, name = rest.partition(".")
    if top != "config" or section == "run":
        return None
    if name == "deadline_s":
        return [position for position, stage in enumerate(line) if stage.section == section]
    return [position for position, stage in enumerate(line) if {section, rest} & set(stage.reads)]


def find_restart_points(lines: Pipelines, kinds: Collection[str], section: str) -> dict[str, int]:
    """Where each kind of line begins again, for `--from SECTION`.

    Raises:
        BuildError: if no stage has this name, with those that there are.
    """
    used = {kind.value: line for kind, line in lines.items() if kind.value in kinds}
    points = {kind: _find_position(line, section) for kind, line in used.items()}
    if lacking := [kind for kind, position in points.items() if position is None]:
        known = dict.fromkeys(stage.section for kind in lacking for stage in used[kind])
        raise BuildError(f"--from {section[:80]!r}: no such stage for a {lacking[0]}; there are {', '.join(known)}")
    return {kind: position for kind, position in points.items() if position is not None}


def _find_position(line: Sequence[Stage], section: str) -> int | None:
    return next((position for position, stage in enumerate(line) if section in (stage.section, stage.name)), None)


def is_append_only(lines: Pipelines, points: Mapping[str, int]) -> bool:
    """Whether all lines begin again at a stage that adds to exported scenes, so that those at rest are its input."""
    return all(line[points[kind.value]].is_post_export for kind, line in lines.items() if kind.value in points)


def suggest_restart_stage(lines: Pipelines, kinds: Collection[str], differing: Collection[str]) -> str:
    """The stage to begin again from, for differences that have one; any, where only code differs; else nothing."""
    firsts = []
    for kind, line in lines.items():
        if kind.value in kinds:
            position = find_first_affected_stage(line, differing)
            if position is None:
                return ""
            firsts.append((len(line) - position, line[position].section if position < len(line) else ""))
    earliest = max(firsts)[1] if firsts else ""
    return earliest or (_STAGE_PLACEHOLDER if CODE in differing else "")


def check_upstream_unchanged(
    lines: Pipelines, points: Mapping[str, int], differing: Collection[str], section: str, suggestion: str
) -> None:
    """Refuses to keep what a change of the configuration has touched.

    Args:
        lines: The stages of each kind.
        points: Where each kind begins again.
        differing: Keys of run.json that differ.
        section: What was asked for.
        suggestion: The earliest stage that is touched; empty where it is not for a stage to say.

    Raises:
        BuildError: naming what differs and the stage that reads it.
    """
    for kind, line in lines.items():
        if kind.value not in points:
            continue
        position = find_first_affected_stage(line, differing)
        if position is None:
            raise BuildError(
                f"{', '.join(sorted(differing)[:4])} changed, which no --from can make good: give another OUT"
            )
        if position < points[kind.value]:
            raise BuildError(
                f"{', '.join(sorted(differing)[:4])} changed, which {line[position].name} reads already: "
                f"give --from {suggestion} instead of --from {section}, or another OUT"
            )


def list_scenes_to_recompute(
    plan: Plan, lines: Pipelines, points: Mapping[str, int], endings: Sequence[SceneStatus]
) -> list[str]:
    """Ids of the scenes that ended at one of the stages that are computed again, or at the end of a shorter line."""
    kind_of = dict(zip(plan.scene_ids, plan.kinds, strict=True))
    again = {
        kind.value: {stage.name for stage in line[points[kind.value] :]}
        for kind, line in lines.items()
        if kind.value in points
    }
    return [
        ending.scene_id
        for ending in endings
        if ending.status == "done" or ending.stage in again[kind_of[ending.scene_id]]
    ]


def delete_checkpoints(records: CheckpointStore, plan: Plan, lines: Pipelines, points: Mapping[str, int]) -> None:
    """Removes what the stages that are computed again gave before."""
    stages = {
        stage.name for kind, line in lines.items() if kind.value in points for stage in line[points[kind.value] :]
    }
    for shard in range(plan.n_shards):
        records.delete(shard, stages)


def write_rerun_marker(out: StoragePath, section: str, record: Mapping[str, Any]) -> None:
    """Writes down that all is taken back and run.json is this: the same command goes on from here.

    Raises:
        BuildError: if the disk or the store refuses.
    """
    write_atomic(out / WORK / MARKER, _encode_marker(section, record))


def is_rerun_under_way(out: StoragePath, section: str, record: Mapping[str, Any]) -> bool:
    """Whether this very beginning again was marked, and no other came after it."""
    try:
        return read_whole(out / WORK / MARKER) == _encode_marker(section, record)
    except FileNotFoundError:
        return False


def read_rerun_stage(out: StoragePath) -> str:
    """The stage from which on a build is computed again; empty where none is under way."""
    try:
        return str(json.loads(read_whole(out / WORK / MARKER))["from"])
    except FileNotFoundError:
        return ""
    except (ValueError, KeyError, TypeError) as error:
        raise BuildError(f"{out / WORK / MARKER} is damaged; the command that was begun last writes it anew") from error


def clear_rerun_marker(out: StoragePath) -> None:
    """Comes before anything is taken back: a mark never stands beside another run.json, or scenes half taken back.

    Raises:
        BuildError: if the disk or the store refuses.
    """
    remove(out / WORK / MARKER)


def _encode_marker(section: str, record: Mapping[str, Any]) -> bytes:
    run = content_hash(json.dumps(record, sort_keys=True).encode())
    return (json.dumps({"from": section, "run_sha256": run}) + "\n").encode()
