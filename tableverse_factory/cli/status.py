"""`tableverse status`: progress of a build, and the costs of its stages."""

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tableverse_factory.cli.options import AsJson, BuiltOut
from tableverse_factory.cli.tables import make_table
from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from schemas.outcome import ModelCost
    from tableverse_factory.core.storage.files import StoragePath
    from tableverse_factory.dataset.judge_summary import JudgeSummary
    from tableverse_factory.dataset.trajectory_summary import TrajectorySummary
    from workers.progress.build_state import BuildState


def status(
    out: BuiltOut,
    as_json: AsJson = False,
    watch: Annotated[bool, typer.Option("--watch", help="Look again and again until the build is complete.")] = False,
    every: Annotated[
        float, typer.Option(min=0.5, max=3600.0, metavar="SECONDS", help="Seconds between two looks of --watch.")
    ] = 5.0,
) -> None:
    """Show what is done, what was lost, and what remains.

    And what each stage costs, what the judge said, and how many trajectories succeed.

    `--watch` follows a build that runs elsewhere; it only reads, and Ctrl-C ends the watching, not the build.

    Example: `tableverse status out --json | jq .remaining` and `tableverse status out --watch --every 30`
    """
    from tableverse_factory.core.storage.files import list_names, parse_path
    from tableverse_factory.dataset.journals import WORK
    from workers.state.lock import LOCK, describe_writer

    place = parse_path(out)
    if "run.json" not in list_names(place) and (writer := describe_writer(place / WORK / LOCK)):
        raise BuildError(f"{out}: a build begins there just now, by {writer}: ask again in a few seconds")
    if watch:
        if as_json:
            raise typer.BadParameter("--watch is for people; run `status --json` as often as you like")
        _follow(place, every)
        return
    from tableverse_factory.dataset.doubtful_scales import SCALE_COLUMNS, list_doubtful_scales
    from tableverse_factory.dataset.judge_summary import JUDGEMENT_COLUMNS, summarize_judgements
    from tableverse_factory.dataset.model_costs import COST_COLUMNS, sum_model_costs
    from tableverse_factory.dataset.provisional import find_cut_scenes
    from tableverse_factory.dataset.trajectory_summary import summarize_trajectories
    from workers.progress.build_state import OUTCOME_COLUMNS, read_build_state
    from workers.state.cost_log import sum_costs

    columns = dict.fromkeys((*OUTCOME_COLUMNS, *JUDGEMENT_COLUMNS, *COST_COLUMNS, *SCALE_COLUMNS))
    state = read_build_state(place, [*columns], ["stage", "cpu_s"])
    verdicts, motions = summarize_judgements(state.stored), summarize_trajectories(place, state.published)
    asked, cut = (sum_model_costs(state.stored), sum_costs(place)), find_cut_scenes(place)
    doubtful = list_doubtful_scales(state.stored)
    if as_json:
        costs = {"costs": {asker: asdict(cost) for asker, cost in asked[0].items()}, "spent": asdict(asked[1])}
        print(_dump_json({**_to_dict(state, verdicts, motions), **costs, "scale_doubtful": doubtful, "damaged": cut}))
    else:
        _print_state(state, place)
        if cut:
            shown = ", ".join(map(sanitize_line, cut[:3]))
            print(f"damaged, as by a loss of power: {pluralize(len(cut), 'scene')} of those done ({shown})")
        _print_judgements(verdicts)
        _print_doubts(doubtful)
        _print_costs(*asked)
        _print_trajectories(motions)


def _follow(out: "StoragePath", every_s: float) -> None:
    import time

    from tableverse_factory.dataset.journals import WORK
    from workers.progress.console import OrderedConsole, ProgressDisplay
    from workers.progress.follow import BuildFollower
    from workers.state.lock import LOCK, describe_writer

    with ProgressDisplay(OrderedConsole()) as progress:
        build = BuildFollower(out)
        if build.read_tally().committed < build.shards and describe_writer(out / WORK / LOCK) is None:
            progress.note("as far as can be seen from here, no build is writing this dataset now")
        while True:
            tally = build.read_tally()
            progress.show(tally)
            if tally.committed == tally.shards:
                return
            time.sleep(every_s)


def _dump_json(figures: dict[str, Any]) -> str:
    """Encode the figures as strict JSON, which has no infinity."""
    try:
        return json.dumps(figures, indent=2, allow_nan=False)
    except ValueError as error:
        raise InputError("a table of this dataset holds a figure that is no number", "bad_table") from error


def _to_dict(state: "BuildState", verdicts: "JudgeSummary", motions: "TrajectorySummary") -> dict[str, Any]:
    counts = ("total", "done", "dropped", "failed", "remaining", "shards", "committed", "fingerprint")
    return {
        **{name: getattr(state, name) for name in counts},
        "funnel": [
            {"status": status, "stage": stage, "why": why, "scenes": count}
            for (status, stage, why), count in state.count_losses().items()
        ],
        "stages": [
            {
                "stage": cost.stage,
                "scenes": cost.scenes,
                "cpu_s_median": round(cost.median_cpu_s, 3),
                "cpu_s_p90": round(cost.p90_cpu_s, 3),
                "cpu_s_total": round(cost.total_cpu_s, 3),
            }
            for cost in state.compute_stage_costs()
        ],
        "judged": asdict(verdicts),
        "trajectories": {
            "tried": motions.tasks,
            "succeeded": motions.succeeded,
            "failed": [
                {"phase": phase, "reason": reason, "tasks": count} for (phase, reason), count in motions.failed.items()
            ],
        },
    }


def _print_state(state: "BuildState", out: "StoragePath") -> None:
    from rich.console import Console

    from tableverse_factory.dataset.journals import WORK
    from tableverse_factory.viz.gallery.formatting import explain_reasons
    from workers.plan.rerun import read_rerun_stage
    from workers.state.lock import LOCK, describe_writer

    console = Console(markup=False)
    console.print(
        f"{pluralize(state.total, 'scene')}: {state.done} done, {state.dropped} dropped, {state.failed} failed, "
        f"{state.remaining} remaining; {state.committed} of {pluralize(state.shards, 'shard')} committed",
        highlight=False,
    )
    losses = state.count_losses()
    if losses:
        table = make_table("status", "stage", "why", figures=["scenes"], title="lost")
        for (status, stage, why), count in losses.items():
            table.add_row(*(sanitize_line(text, 80) for text in (status, stage, why)), str(count))
        console.print(table)
        for line in explain_reasons(why for _, _, why in losses):
            print(line)
    if costs := state.compute_stage_costs():
        total = sum(cost.total_cpu_s for cost in costs) or 1.0
        table = make_table("stage", figures=("scenes", "median", "p90", "total", "share"), title="CPU seconds")
        for cost in costs:
            figures = (f"{cost.median_cpu_s:.2f}", f"{cost.p90_cpu_s:.2f}", f"{cost.total_cpu_s:.1f}")
            table.add_row(sanitize_line(cost.stage, 80), str(cost.scenes), *figures, f"{cost.total_cpu_s / total:.0%}")
        console.print(table)
    writer = describe_writer(out / WORK / LOCK)
    if writer is not None:
        print(f"being written by {writer}")
    if not state.remaining:
        return
    again = read_rerun_stage(out) == "trajectories"
    command = f"build MANIFEST {out} with what it was begun with"
    if again and len(state.published) == state.shards:  # it lacks only trajectories, which need no manifest
        command = f"trajectories {out} with its --set, if any"
    if writer is None:
        print(f"to go on: tableverse {command}")
    if again:
        print("rows of trajectories appear when their shard is complete")


def _print_judgements(verdicts: "JudgeSummary") -> None:
    for name, count in verdicts.judges.items():
        print(f"judged by {sanitize_line(name, 100)}: {pluralize(count, 'scene')}")
    if (agreement := verdicts.agreement) is not None:
        print(
            f"beside the rules: same gate {agreement.usable_share:.0%}, score {agreement.score_difference:+.1f}, "
            f"same nouns {agreement.names_share:.0%}, masses × {agreement.mass_ratio:.2f}, "
            f"tasks shared {agreement.tasks_share:.0%}"
        )
    if verdicts.judged:
        print(f"usable: {verdicts.usable} of {pluralize(verdicts.judged, 'scene')}")
    for code, count in verdicts.remarks.items():
        print(f"verdicts corrected by checks: {sanitize_line(code, 60)} × {count}")


def _print_doubts(doubtful: "Sequence[str]") -> None:
    from tableverse_factory.dataset.doubtful_scales import DOUBTFUL_DEVIATION

    if doubtful:
        shown = f"{', '.join(map(sanitize_line, doubtful[:3]))}{', …' if len(doubtful) > 3 else ''}"
        print(
            f"known length over {DOUBTFUL_DEVIATION:g} standard deviations from what the depth model estimated, "
            f"check it: {pluralize(len(doubtful), 'scene')} ({shown})"
        )


def _print_costs(answers: "Mapping[str, ModelCost]", spent: "ModelCost") -> None:
    from tableverse_factory.dataset.model_costs import format_cost

    for asker, cost in answers.items():
        print(f"answers of the {asker}'s model: {format_cost(cost)}")
    if spent:
        print(f"spent by this dataset so far: {format_cost(spent)}")


def _print_trajectories(motions: "TrajectorySummary") -> None:
    from rich.console import Console

    if not motions.tasks:
        return
    share = motions.succeeded / motions.tasks
    print(f"trajectories: {pluralize(motions.tasks, 'task')} tried, {motions.succeeded} succeeded ({share:.0%})")
    if motions.failed:
        table = make_table("failed in", "why", figures=["tasks"])
        for (phase, reason), count in motions.failed.items():
            table.add_row(sanitize_line(phase, 40), sanitize_line(reason, 80), str(count))
        Console(markup=False).print(table)
