"""Start of a build in its folder: a new one, a resumed one, or a recomputation from some stage on."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pyarrow.compute as pc

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.journals import WORK
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
from workers.plan.manifest_change import describe_manifest_change
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

AGAIN_OPTION = "--again"  # option of `tableverse trajectories` that recomputes its stage


def check_output_dir(out: StoragePath) -> None:
    """Refuse a folder with other content."""
    if out.is_file():
        raise BuildError(f"{out} is a file: give a folder for the dataset")
    names = list_names(out)
    others = [name for name in names if name != WORK and not name.startswith("plan.")]
    if others and "run.json" not in names:
        raise BuildError(f"{out} holds {', '.join(others[:5])} but no build: give a new or an empty folder")


def start_or_resume(
    out: StoragePath,
    rows: Sequence[ImageRow],
    pipelines: Pipelines,
    config: Config,
    recorded: Mapping[str, Any],
    section: str | None = None,
    guard: Callable[[], None] = lambda: None,
    base: Mapping[str, Any] | None = None,
) -> tuple[Plan, Callable[[], None]]:
    """Start a build, or check that it may resume the one in `out`, whose lock is held.

    Stages that were added at the end of the pipelines since are computed for the scenes that are done without them.
    `section` is of the first stage to recompute; a recomputation that is under way from it with this configuration is
    resumed. `guard` raises if this process is no longer the writer. `base` is run.json, if the rows were restored from
    the dataset itself: only added stages may differ then.

    Returns the plan, and a function that records a new build in `out`, to be called when an executor has accepted it:
    one that is refused until then, as by a preflight, leaves nothing that would refuse another one. What is computed
    again is recorded at once.
    """
    plan = make_plan(rows, config.run.shard_size) if base is None else read_plan(out / "plan.parquet")
    fingerprints = {
        kind.value: compute_stage_fingerprints(pipelines, kind, config, recorded)
        for kind in _list_kinds(pipelines, plan)
    }
    record = _make_run_record(rows, plan, pipelines, config, recorded, fingerprints, base)
    run_json = out / "run.json"
    before = read_run(run_json) if run_json.exists() else None
    added = "" if before is None else _find_added_stage(out, before, record)
    section = section or added or None
    points = {} if section is None else find_restart_points(pipelines, plan.kinds, section)

    def record_build() -> None:
        guard()
        if before is None:
            write_plan(out / "plan.parquet", plan)
        write_run(run_json, record)
        if section is not None:
            write_rerun_marker(out, section, record)

    if before is not None:
        differing = diff_run_records(before, record)
        _check_same_build(out, plan, rows, pipelines, points, differing, section, "" if base is None else AGAIN_OPTION)
        if section is None or (not added and not differing and is_rerun_under_way(out, section, record)):
            return plan, lambda: None
        _invalidate_from(out, plan, rows, pipelines, points, fingerprints, guard)
        record_build()
        return plan, lambda: None
    return plan, record_build


def _list_kinds(pipelines: Pipelines, plan: Plan) -> list[SceneKind]:
    return [kind for kind in pipelines if kind.value in plan.kinds]


def _make_run_record(
    rows: Sequence[ImageRow],
    plan: Plan,
    pipelines: Pipelines,
    config: Config,
    recorded: Mapping[str, Any],
    fingerprints: Mapping[str, Mapping[str, str]],
    base: Mapping[str, Any] | None,
) -> dict[str, Any]:
    stages = {name: value for of_kind in fingerprints.values() for name, value in of_kind.items()}
    if base is None:
        return make_run_record(config, recorded, digest_manifest(rows), len(rows), stages)
    post_export = {
        stage.name for kind in _list_kinds(pipelines, plan) for stage in pipelines[kind] if stage.is_post_export
    }
    return extend_run_record(base, config, recorded, {name: stages[name] for name in stages if name in post_export})


def _find_added_stage(out: StoragePath, before: Mapping[str, Any], record: Mapping[str, Any]) -> str:
    """Find the first stage that was added since the start of the build; empty if there is none."""
    if before.get("manifest") != record["manifest"]:
        return ""  # another build altogether
    had, has = before.get("stages", {}), record["stages"]
    if lost := [name for name in had if name not in has]:
        raise BuildError(f"{out} was begun with the stage {lost[0]}: add --stages +{lost[0]}, or give another OUT")
    return next((name for name in has if name not in had), "")


def _check_same_build(
    out: StoragePath,
    plan: Plan,
    rows: Sequence[ImageRow],
    pipelines: Pipelines,
    points: Mapping[str, int],
    differing: Mapping[str, tuple[Any, Any]],
    section: str | None,
    option: str,
) -> None:
    """Refuse another build than the started one, except for the stages to recompute."""
    earliest = suggest_restart_stage(pipelines, plan.kinds, differing)
    if section is None and differing:
        is_other = any(key.startswith("manifest.") for key in differing)
        manifest = describe_manifest_change(out, plan, rows) if is_other else ""
        raise resume_refused_error(str(out), differing, earliest, option, manifest)
    if read_plan(out / "plan.parquet") != plan:
        raise BuildError(f"{out / 'plan.parquet'} was changed after the build began: give another OUT")
    if section is not None:
        check_upstream_unchanged(pipelines, points, differing, section, earliest)


def _invalidate_from(
    out: StoragePath,
    plan: Plan,
    rows: Sequence[ImageRow],
    pipelines: Pipelines,
    points: Mapping[str, int],
    fingerprints: Mapping[str, Mapping[str, str]],
    guard: Callable[[], None],
) -> None:
    """Invalidate the outputs of the stages to recompute; a kill in between leaves the old build resumable.

    Shards that a kill left unpublished are published first, because a shard half in place does not show all scenes. If
    only stages that add to exported scenes are recomputed, those scenes stay their input.
    """
    guard()
    clear_rerun_marker(out)
    publish_ready(out, guard)
    scenes = read_build_state(out, ("scene_id", "status", "stage"), ()).scenes
    if is_append_only(pipelines, points):
        done = scenes["scene_id"].filter(pc.equal(scenes["status"], "done"))
        checkpoint_exported_scenes(out, plan, rows, fingerprints, done.to_pylist())
    invalidate_scenes(out, plan, list_scenes_to_recompute(plan, pipelines, points, scenes))
    delete_checkpoints(CheckpointStore(out / CHECKPOINTS), plan, pipelines, points)


def compute_stage_fingerprints(
    pipelines: Pipelines, kind: SceneKind, config: Config, recorded: Mapping[str, Any]
) -> dict[str, str]:
    """Compute the fingerprint of each stage of a kind of row, in order."""
    parts = map_parts_to_stages()
    by_stage = {stage: {k: v for k, v in recorded.items() if parts[k] == stage} for stage in parts.values()}
    return fingerprint_stages(pipelines[kind], config, by_stage)
