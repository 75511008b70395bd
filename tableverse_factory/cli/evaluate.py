"""`tableverse evaluate`: collisions, judge's marks and layout errors of the scenes of any methods."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile, Epsilon, Overrides, require_local_path
from tableverse_factory.cli.tables import print_figures, print_json
from tableverse_factory.core.cache_dir import get_cache_dir
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.evaluation.methods.collisions import MethodCollisions
    from tableverse_factory.evaluation.methods.layout import SceneLayout
    from tableverse_factory.evaluation.methods.score import VoteResults

_SHOWN_LINES = 3

evaluate = typer.Typer(name="evaluate", help="Compare the scenes of any methods.", no_args_is_help=True)

Methods = Annotated[
    list[str] | None, typer.Option("--method", help="A method as NAME=PATH; may repeat.", metavar="NAME=PATH")
]
Paths = Annotated[list[Path] | None, typer.Argument(help="Methods, as in `evaluate collisions`.")]
Reference = Annotated[
    Path | None, typer.Option(help="Folder of the real pictures; by default, those in a dataset.", file_okay=False)
]
Rounds = Annotated[int, typer.Option(min=1, max=12, help="Questions per scene, at most one per method.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the order of columns and of the intervals.")]
Cell = Annotated[int, typer.Option(min=64, max=1024, help="Side of a cell of the grid [px].")]


@evaluate.command("collisions")
def evaluate_collisions(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(help="Datasets, layouts, GLB or MJCF scenes, or folders of them; named after their folder."),
    ] = None,
    method: Methods = None,
    epsilon_m: Epsilon = 0.0001,
    meshes_only: Annotated[
        bool, typer.Option("--meshes-only", help="Skip the convex pieces, which take time to make.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Count the scenes in which two objects overlap, on meshes and on convex pieces.

    Exit code 1 if a scene could not be measured; it is named and does not count.

    Example: `tableverse evaluate collisions --method ours=out --method midi=midi/ --epsilon 0.001`
    """
    from tableverse_factory.cli.progress_bar import track_progress
    from tableverse_factory.evaluation.methods.collisions import measure_method
    from tableverse_factory.evaluation.methods.sources import count_dropped_scenes, find_scenes, parse_methods

    cache = None if meshes_only else get_cache_dir()
    methods = parse_methods(paths or [], method or [])
    sources = {name: find_scenes(path) for name, path in methods.items()}
    measured = [
        measure_method(name, track_progress(name, its, len(its)), epsilon_m, cache, count_dropped_scenes(methods[name]))
        for name, its in sources.items()
    ]
    if as_json:
        print_json({"epsilon_m": epsilon_m, "methods": [each.as_json() for each in measured]}, indent=1)
    else:
        _show_collisions(measured, epsilon_m)
    if any(scene.error for each in measured for scene in each.scenes):
        raise typer.Exit(1)


def _show_collisions(methods: "list[MethodCollisions]", epsilon_m: float) -> None:
    import numpy as np

    rows = []
    for each in methods:
        depths = [1e3 * scene.depth_m for scene in each.measured] or [float("nan")]
        low, high = each.interval() or (float("nan"), float("nan"))
        interval = f"{100 * low:.0f}–{100 * high:.0f}"
        rates = _percent(each.rate()), interval, _percent(each.piece_rate())
        spread = f"{np.median(depths):.2f}", f"{max(depths):.2f}"
        counts = len(each.measured), sum(scene.objects for scene in each.measured)
        rows.append((sanitize_line(each.method, 40), *counts, *rates, *spread))
    figures = ("scenes", "objects", "colliding %", "95 %", "on pieces %", "median mm", "deepest mm")
    title = f"scenes in which two objects overlap by more than {1e3 * epsilon_m:g} mm"
    print_figures(("method", *figures), rows, title)
    for each in methods:
        if each.dropped:
            print(sanitize_line(f"{each.method}: without {each.dropped} scenes that the factory dropped", 300))
        failed = [scene for scene in each.scenes if scene.error]
        _print_first(f"not measured: {each.method}: {scene.name}: {scene.error}" for scene in failed)


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"


@evaluate.command("gpt-score")
def evaluate_gpt_score(
    out: Annotated[
        Path, typer.Option("--out", callback=require_local_path, help="Folder for grids, answers and results.")
    ],
    paths: Paths = None,
    method: Methods = None,
    reference: Reference = None,
    rounds: Rounds = 1,
    seed: Seed = 0,
    cell: Cell = 448,
    grids_only: Annotated[bool, typer.Option("--grids-only", help="Write the grids without asking the judge.")] = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Let a model mark the scenes of every method against the real picture, columns shuffled.

    The section `curate` of the configuration names the judge. Writes grids/, answers/ (for `curate.judge=replay`) and
    gpt-score.json, for the scenes that all methods have. Exit code 1 if a question got no valid answer.

    Example: `tableverse evaluate gpt-score --method ours=out --method midi=midi/ --reference pictures --out score
    --rounds 2 --set curate.judge=gemini --set curate.model=gemini-2.5-pro --set curate.key_env=GEMINI_API_KEY`
    """
    from tableverse_factory.cli.progress_bar import track_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.methods.comparison import check_shared_scenes, match_methods
    from tableverse_factory.evaluation.methods.grid_judges import make_grid_judge
    from tableverse_factory.evaluation.methods.score import ask_all, write_grids
    from tableverse_factory.evaluation.methods.sources import parse_methods
    from tableverse_factory.models.services import Services

    comparison = match_methods(parse_methods(paths or [], method or []), reference, cell)
    check_shared_scenes(comparison)
    for lacking, names in comparison.missing.items():
        print(f"{lacking} lacks {len(names)} scenes, e.g. {names[0]}: left out for all", file=sys.stderr)
    if grids_only:
        print(f"{write_grids(comparison, rounds, seed, out)} grids in {out / 'grids'}")
        return
    settings = load_config(config, overrides or [])
    judge = make_grid_judge(settings.curate, Services(get_cache_dir(), settings.asking))
    votes = ask_all(comparison, judge, rounds, seed, out, lambda asked: track_progress("judge", asked, len(asked)))
    _report_score(votes, seed, out, as_json)
    if votes.refused or not votes.votes:
        raise typer.Exit(1)


def _report_score(votes: "VoteResults", seed: int, out: Path, as_json: bool) -> None:
    import json

    from tableverse_factory.core.storage.files import write_atomic
    from tableverse_factory.evaluation.methods.score import results_to_json as score_as_json

    text = json.dumps(score_as_json(votes, seed), indent=1)
    write_atomic(out / "gpt-score.json", f"{text}\n".encode())
    if as_json:
        print(text)
    else:
        _show_score(votes, seed)


def _show_score(votes: "VoteResults", seed: int) -> None:
    from tableverse_factory.evaluation.methods.score import compute_rank_by_column, compute_results, format_interval
    from tableverse_factory.evaluation.methods.vlm_vote import METRICS

    title = f"marks of 1 to 10 and mean rank, with 95 % intervals, from {len(votes.votes)} answers"
    rows = (
        (sanitize_line(method, 40), *(format_interval(marks[metric]) for metric in METRICS))
        for method, marks in compute_results(votes, seed).items()
    )
    print_figures(["method", *(name.replace("_", " ") for name in METRICS)], rows, title)
    places = (f"{letter} {rank:.2f}" for letter, rank in compute_rank_by_column(votes).items())
    print(f"mean rank by column over all methods: {', '.join(places)}")
    _print_first(f"no valid answer: {its.scene}, round {its.round}: {its.reason}" for its in votes.refused)


@evaluate.command("layout")
def evaluate_layout(
    truth: Annotated[
        Path, typer.Option(help="Folder of the truth: poses (*.json), synthetic captures, or scenes.", exists=True)
    ],
    paths: Paths = None,
    method: Methods = None,
    as_json: AsJson = False,
) -> None:
    """Compare layouts with the truth: positions, sizes, headings, support and containment.

    Exit code 1 if a scene with a truth could not be compared.

    Example: `tableverse evaluate layout layouts --truth layouts/truth`, or `… layout out --truth captures`
    """
    from tableverse_factory.evaluation.methods.comparison import index_by_shared_name
    from tableverse_factory.evaluation.methods.layout import compare_layouts, summarize_layouts
    from tableverse_factory.evaluation.methods.sources import find_scenes, parse_methods
    from tableverse_factory.evaluation.methods.truth import find_truths

    truths = find_truths(truth)
    compared = {
        name: compare_layouts(index_by_shared_name(find_scenes(path)), truths, get_cache_dir())
        for name, path in parse_methods(paths or [], method or []).items()
    }
    summaries = {name: summarize_layouts(scenes) for name, scenes in compared.items()}
    if as_json:
        print_json({name: {"summary": its, "scenes": compared[name]} for name, its in summaries.items()}, indent=1)
    else:
        _show_layouts(summaries, compared)
    if any(scene.error for scenes in compared.values() for scene in scenes):
        raise typer.Exit(1)


def _show_layouts(
    summaries: "dict[str, dict[str, float | None]]", compared: "Mapping[str, Sequence[SceneLayout]]"
) -> None:
    from tableverse_factory.evaluation.methods.layout import NO_RESULT

    rows = []
    for row in next(iter(summaries.values())):
        cells = (its[row] for its in summaries.values())
        rows.append((row, *("–" if cell is None else f"{cell:.4g}" for cell in cells)))
    print_figures(["", *(sanitize_line(name, 300) for name in summaries)], rows)
    for name, scenes in compared.items():
        failed = sorted((scene for scene in scenes if scene.error), key=lambda its: its.error == NO_RESULT)
        _print_first(f"not compared: {name}: {scene.name}: {scene.error}" for scene in failed)


@evaluate.command("tables")
def evaluate_tables(
    folder: Annotated[
        Path, typer.Argument(help="Results: a subfolder for each method, and answers/.", exists=True, file_okay=False)
    ],
    out: Annotated[
        Path,
        typer.Option("--out", callback=require_local_path, help="Folder for table1.md, table2.md and tables.json."),
    ],
    answers: Annotated[
        Path | None,
        typer.Option(help="Answers that `evaluate gpt-score` recorded, if elsewhere.", exists=True, file_okay=False),
    ] = None,
    epsilon_m: Epsilon = 0.0001,
    pieces: Annotated[bool, typer.Option("--pieces", help="Add rates on convex pieces to tables.json.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the bootstrap.")] = 0,
) -> None:
    """Write the paper's tables: methods compared, and the collisions left after each step of the factory.

    The second table is of methods that are datasets of ours, whose scenes hold their poses of every step. No model is
    asked: the marks come from recorded answers. Exit code 1 if a scene could not be measured, or a recorded answer is
    invalid.

    Example: `tableverse evaluate tables results --out results/tables`
    """
    from tableverse_factory.evaluation.methods.tables import make_tables, write_tables

    tables = make_tables(folder, epsilon_m, seed, answers, get_cache_dir() if pieces else None)
    for path in write_tables(tables, out):
        print(path)
        if path.suffix == ".md":
            print(path.read_text())
    if not tables.complete:
        raise typer.Exit(1)


def _print_first(lines: Iterable[str]) -> None:
    """Print the first lines and the number of the others: a wrong folder would print one per scene."""
    found = list(lines)
    for line in found[:_SHOWN_LINES]:
        print(sanitize_line(line, 300))
    if len(found) > _SHOWN_LINES:
        print(f"… and {len(found) - _SHOWN_LINES} more like this; --json names all")
