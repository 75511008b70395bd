"""How a build begins in its folder: as a new one, as the one that was begun there, or again from some stage on."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.errors import BuildError
from tableverse_factory.plan import Plan, make_plan, manifest_digest, read_plan, write_plan
from tableverse_factory.provenance import (
    RECORDED_BY,
    another_build,
    differences,
    read_run,
    run_record,
    write_run,
)
from tableverse_factory.stage import Lines
from tableverse_factory.storage import Place, names_in
from workers.again import (
    advice,
    check_untouched,
    forget_records,
    is_under_way,
    mark,
    starting_points,
    taken_back,
    unmark,
)
from workers.commit import publish_ready
from workers.ledger import WORK
from workers.records import RECORDS, Records, stage_fingerprints
from workers.reopen import take_back
from workers.survey import survey


def check_out(out: Place) -> None:
    """Keeps a build out of folders that are somebody else's.

    Raises:
        BuildError: naming what is there.
    """
    if out.is_file():
        raise BuildError(f"{out} is a file: give a folder for the dataset")
    names = names_in(out)
    strangers = [name for name in names if name != WORK and not name.startswith("plan.")]
    if strangers and "run.json" not in names:
        raise BuildError(f"{out} holds {', '.join(strangers[:5])} but no build: give a new or an empty folder")


def begin(
    out: Place,
    rows: Sequence[ImageRow],
    lines: Lines,
    config: Config,
    recorded: Mapping[str, Any],
    section: str | None = None,
    guard: Callable[[], None] = lambda: None,
) -> Plan:
    """Begins a build, or checks that it is the one that was begun here, as far as it is not computed again.

    Args:
        out: The dataset, locked.
        rows: Of the manifest.
        lines: The stages of each kind of row.
        config: Of the build.
        recorded: From `provenance.recorded_inputs`.
        section: Of the stage from which on everything is computed again; None to go on. Where that is under way
            already, from this stage and with this configuration, it goes on too.
        guard: Called before anything is taken back; raises where this process is no longer the writer.

    Raises:
        BuildError: if another build was begun here, or no stage has this name.
    """
    plan = make_plan(rows, config.run.shard_size)
    points = {} if section is None else starting_points(lines, plan.kinds, section)
    kinds = [kind for kind in lines if kind.value in plan.kinds]
    stages = {name: value for kind in kinds for name, value in fingerprints_of(lines, kind, config, recorded).items()}
    record = run_record(config, recorded, manifest_digest(rows), len(rows), stages)
    run_json = out / "run.json"
    if run_json.exists():
        differing = differences(read_run(run_json), record)
        _check_same(out, plan, lines, points, differing, section)
        if section is None or (not differing and is_under_way(out, section, record)):
            return plan
        _take_back_from(out, plan, lines, points, guard)
        guard()
    else:
        write_plan(out / "plan.parquet", plan)
    write_run(run_json, record)
    if section is not None:
        mark(out, section, record)
    return plan


def _check_same(
    out: Place,
    plan: Plan,
    lines: Lines,
    points: Mapping[str, int],
    differing: Mapping[str, tuple[Any, Any]],
    section: str | None,
) -> None:
    """Refuses another build than the one that was begun, but for what is computed again."""
    earliest = advice(lines, plan.kinds, differing)
    if section is None and differing:
        raise another_build(str(out), differing, earliest)
    if read_plan(out / "plan.parquet") != plan:
        raise BuildError(f"{out / 'plan.parquet'} was changed after the build began: give another OUT")
    if section is not None:
        check_untouched(lines, points, differing, section, earliest)


def _take_back_from(out: Place, plan: Plan, lines: Lines, points: Mapping[str, int], guard: Callable[[], None]) -> None:
    """Takes back what came of the stages that are computed again; a kill in between leaves the old build to go on.

    What a kill left to be published comes first: of a shard that is half in its place not all scenes are seen.
    """
    guard()
    unmark(out)
    publish_ready(out, out / WORK, guard)
    take_back(out, plan, taken_back(plan, lines, points, survey(out).endings))
    forget_records(Records(out / RECORDS), plan, lines, points)


def fingerprints_of(lines: Lines, kind: SceneKind, config: Config, recorded: Mapping[str, Any]) -> dict[str, str]:
    """Fingerprint of each stage that a row of this kind runs through, in order."""
    by_stage = {stage: {k: v for k, v in recorded.items() if RECORDED_BY[k] == stage} for stage in RECORDED_BY.values()}
    return stage_fingerprints(lines[kind], config, by_stage)
