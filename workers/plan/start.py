"""How a build begins in its folder: as a new one, as the one that was begun there, or again from some stage on."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.shard_plan import Plan, digest_manifest, make_plan, read_plan, write_plan
from tableverse_factory.run_record import (
    diff_run_records,
    extend_run_record,
    make_run_record,
    map_parts_to_stages,
    read_run,
    resume_refused_error,
    write_run,
)
from tableverse_factory.stage import Pipelines
from workers.plan.checkpoint_from_shards import checkpoint_exported_scenes
from workers.plan.invalidate import invalidate_scenes
from workers.plan.rerun import (
    check_upstream_unchanged,
    clear_rerun_marker,
    delete_checkpoints,
    find_restart_points,
    is_append_only,
    is_rerun_under_way,
    list_scenes_to_recompute,
    suggest_restart_stage,
    write_rerun_marker,
)
from workers.progress.build_state import read_build_state
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore, fingerprint_stages
from workers.state.commit import publish_ready
from workers.state.ledger import WORK

AGAIN_OPTION = "--again"
"""What `tableverse trajectories` calls computing its stage again."""


def check_output_dir(out: StoragePath) -> None:
    """Keeps a build out of folders that are somebody else's.

    Raises:
        BuildError: naming what is there.
    """
    if out.is_file():
        raise BuildError(f"{out} is a file: give a folder for the dataset")
    names = list_names(out)
    strangers = [name for name in names if name != WORK and not name.startswith("plan.")]
    if strangers and "run.json" not in names:
        raise BuildError(f"{out} holds {', '.join(strangers[:5])} but no build: give a new or an empty folder")


def start_or_resume(
    out: StoragePath,
    rows: Sequence[ImageRow],
    lines: Pipelines,
    config: Config,
    recorded: Mapping[str, Any],
    section: str | None = None,
    guard: Callable[[], None] = lambda: None,
    base: Mapping[str, Any] | None = None,
) -> Plan:
    """Begins a build, or checks that it is the one that was begun here, as far as it is not computed again.

    Where the line has grown since by stages at its end, these are computed for what was done without them.

    Args:
        out: The dataset, locked.
        rows: Of the manifest.
        lines: The stages of each kind of row.
        config: Of the build.
        recorded: From `run_record.collect_external_inputs`.
        section: Of the stage from which on everything is computed again; None to go on. Where that is under way
            already, from this stage and with this configuration, it goes on too.
        guard: Called before anything is taken back; raises where this process is no longer the writer.
        base: From run.json, where the rows were restored from the dataset itself: all but the stages that are added
            stays as it was.

    Raises:
        BuildError: if another build was begun here, or no stage has this name.
    """
    plan = make_plan(rows, config.run.shard_size) if base is None else read_plan(out / "plan.parquet")
    fingerprints = {
        kind.value: compute_stage_fingerprints(lines, kind, config, recorded) for kind in _list_kinds(lines, plan)
    }
    record = _make_run_record(rows, plan, lines, config, recorded, fingerprints, base)
    run_json = out / "run.json"
    before = read_run(run_json) if run_json.exists() else None
    grown = "" if before is None else _find_added_stage(out, before, record)
    section = section or grown or None
    points = {} if section is None else find_restart_points(lines, plan.kinds, section)
    if before is None:
        write_plan(out / "plan.parquet", plan)
    else:
        differing = diff_run_records(before, record)
        _check_same_build(out, plan, lines, points, differing, section, "" if base is None else AGAIN_OPTION)
        if section is None or (not grown and not differing and is_rerun_under_way(out, section, record)):
            return plan
        _invalidate_from(out, plan, rows, lines, points, fingerprints, guard)
        guard()
    write_run(run_json, record)
    if section is not None:
        write_rerun_marker(out, section, record)
    return plan


def _list_kinds(lines: Pipelines, plan: Plan) -> list[SceneKind]:
    """Kinds of the plan's rows."""
    return [kind for kind in lines if kind.value in plan.kinds]


def _make_run_record(
    rows: Sequence[ImageRow],
    plan: Plan,
    lines: Pipelines,
    config: Config,
    recorded: Mapping[str, Any],
    fingerprints: Mapping[str, Mapping[str, str]],
    base: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """What run.json says from now on."""
    stages = {name: value for of_kind in fingerprints.values() for name, value in of_kind.items()}
    if base is None:
        return make_run_record(config, recorded, digest_manifest(rows), len(rows), stages)
    adding = {stage.name for kind in _list_kinds(lines, plan) for stage in lines[kind] if stage.is_post_export}
    return extend_run_record(base, config, recorded, {name: stages[name] for name in stages if name in adding})


def _find_added_stage(out: StoragePath, before: Mapping[str, Any], record: Mapping[str, Any]) -> str:
    """The first stage that the line has now and had not when the build began; empty where there is none.

    Raises:
        BuildError: if it had one that it has not now.
    """
    if before.get("manifest") != record["manifest"]:
        return ""  # another build altogether
    had, has = before.get("stages", {}), record["stages"]
    if lost := [name for name in had if name not in has]:
        raise BuildError(f"{out} was begun with the stage {lost[0]}: add --stages +{lost[0]}, or give another OUT")
    return next((name for name in has if name not in had), "")


def _check_same_build(
    out: StoragePath,
    plan: Plan,
    lines: Pipelines,
    points: Mapping[str, int],
    differing: Mapping[str, tuple[Any, Any]],
    section: str | None,
    option: str,
) -> None:
    """Refuses another build than the one that was begun, but for what is computed again."""
    earliest = suggest_restart_stage(lines, plan.kinds, differing)
    if section is None and differing:
        raise resume_refused_error(str(out), differing, earliest, option)
    if read_plan(out / "plan.parquet") != plan:
        raise BuildError(f"{out / 'plan.parquet'} was changed after the build began: give another OUT")
    if section is not None:
        check_upstream_unchanged(lines, points, differing, section, earliest)


def _invalidate_from(
    out: StoragePath,
    plan: Plan,
    rows: Sequence[ImageRow],
    lines: Pipelines,
    points: Mapping[str, int],
    fingerprints: Mapping[str, Mapping[str, str]],
    guard: Callable[[], None],
) -> None:
    """Takes back what came of the stages that are computed again; a kill in between leaves the old build to go on.

    What a kill left to be published comes first: of a shard that is half in its place not all scenes are seen. Where
    only stages begin again that add to what was exported, that stays their input.
    """
    guard()
    clear_rerun_marker(out)
    publish_ready(out, out / WORK, guard)
    endings = read_build_state(out).scenes
    if is_append_only(lines, points):
        checkpoint_exported_scenes(
            out, plan, rows, fingerprints, {ending.scene_id for ending in endings if ending.status == "done"}
        )
    invalidate_scenes(out, plan, list_scenes_to_recompute(plan, lines, points, endings))
    delete_checkpoints(CheckpointStore(out / CHECKPOINTS), plan, lines, points)


def compute_stage_fingerprints(
    lines: Pipelines, kind: SceneKind, config: Config, recorded: Mapping[str, Any]
) -> dict[str, str]:
    """Fingerprint of each stage that a row of this kind runs through, in order."""
    parts = map_parts_to_stages()
    by_stage = {stage: {k: v for k, v in recorded.items() if parts[k] == stage} for stage in parts.values()}
    return fingerprint_stages(lines[kind], config, by_stage)
