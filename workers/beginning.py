"""How a build begins in its folder: as a new one, as the one that was begun there, or again from some stage on."""

from collections.abc import Mapping, Sequence

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.errors import BuildError
from tableverse_factory.plan import Plan, make_plan, manifest_digest, read_plan, write_plan
from tableverse_factory.provenance import (
    RECORDED_BY,
    another_build,
    differences,
    read_run,
    recorded_inputs,
    run_record,
    write_run,
)
from tableverse_factory.stage import Lines
from tableverse_factory.storage import Place, names_in
from workers.again import advice, check_untouched, forget_records, starting_points, taken_back
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


def begin(out: Place, rows: Sequence[ImageRow], lines: Lines, config: Config, section: str | None) -> Plan:
    """Begins a build, or checks that it is the one that was begun here, as far as it is not computed again.

    Args:
        out: The dataset, locked.
        rows: Of the manifest.
        lines: The stages of each kind of row.
        config: Of the build.
        section: Of the stage from which on everything is computed again; None to go on.

    Raises:
        BuildError: if another build was begun here, or no stage has this name.
    """
    plan = make_plan(rows, config.run.shard_size)
    kinds = [kind for kind in lines if kind.value in plan.kinds]
    stages = {name: value for kind in kinds for name, value in fingerprints_of(lines, kind, config).items()}
    record = run_record(config, manifest_digest(rows), len(rows), stages)
    run_json, plan_file = out / "run.json", out / "plan.parquet"
    if not run_json.exists():
        write_plan(plan_file, plan)
        write_run(run_json, record)
        return plan
    differing = differences(read_run(run_json), record)
    earliest = advice(lines, plan.kinds, differing)
    if section is None and differing:
        raise another_build(str(out), differing, earliest)
    if read_plan(plan_file) != plan:
        raise BuildError(f"{plan_file} was changed after the build began: give another OUT")
    if section is not None:
        points = starting_points(lines, plan.kinds, section)
        check_untouched(lines, points, differing, section, earliest)
        _begin_again(out, plan, lines, points)
        write_run(run_json, record)
    return plan


def _begin_again(out: Place, plan: Plan, lines: Lines, points: Mapping[str, int]) -> None:
    """Takes back what came of the stages that are computed again; a kill in between leaves the old build to go on."""
    take_back(out, plan, taken_back(plan, lines, points, survey(out).endings))
    forget_records(Records(out / RECORDS), plan, lines, points)


def fingerprints_of(lines: Lines, kind: SceneKind, config: Config) -> dict[str, str]:
    """Fingerprint of each stage that a row of this kind runs through, in order."""
    recorded = recorded_inputs(config)
    by_stage = {stage: {k: v for k, v in recorded.items() if RECORDED_BY[k] == stage} for stage in RECORDED_BY.values()}
    return stage_fingerprints(lines[kind], config, by_stage)
