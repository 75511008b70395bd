"""`tableverse evaluate`: any method's scenes against one another, against a judge, against the truth."""

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

if TYPE_CHECKING:
    from tableverse_factory.evaluation.methods.collisions import MethodCollisions
    from tableverse_factory.evaluation.methods.layout import SceneLayout
    from tableverse_factory.evaluation.methods.score import VoteResults

T = TypeVar("T")
_SHOWN_LINES = 3

evaluate = typer.Typer(name="evaluate", help="Compare the scenes of any methods.", no_args_is_help=True)

Methods = Annotated[
    list[str] | None, typer.Option("--method", help="NAME=PATH; as often as there are methods.", metavar="NAME=PATH")
]
Paths = Annotated[list[Path] | None, typer.Argument(help="Methods, as in `evaluate collisions`.")]
Reference = Annotated[
    Path | None,
    typer.Option(help="Folder of the real pictures; without it, those that a dataset keeps.", file_okay=False),
]
Rounds = Annotated[
    int, typer.Option(min=1, max=12, help="Times each scene is asked about, at most once for each method.")
]
Seed = Annotated[int, typer.Option(min=0, help="Of the order of columns and of the intervals.")]
Cell = Annotated[int, typer.Option(min=64, max=1024, help="Side of a cell of the grid [px].")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Its section `curate` names the judge.")]
Overrides = Annotated[list[str] | None, typer.Option("--set", help="A key of the configuration.", metavar="KEY=VALUE")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document instead of a table.")]


@evaluate.command("collisions")
def evaluate_collisions(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(help="Datasets, layouts, GLB or MJCF scenes, or folders of them; named after their folder."),
    ] = None,
    method: Methods = None,
    epsilon_m: Annotated[
        float, typer.Option("--epsilon", min=0.0, help="Depth that is no collision yet [m].")
    ] = 0.0001,
    meshes_only: Annotated[
        bool, typer.Option("--meshes-only", help="Leave out the convex pieces, which take time to make.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Count the scenes in which any two objects lie inside one another, on meshes and on convex pieces.

    Exit code 1 if a scene could not be measured; it is named, and does not count.

    Example: `tableverse evaluate collisions --method ours=out --method midi=midi/ --epsilon 0.001`
    """
    import json

    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.evaluation.methods.collisions import measure_method
    from tableverse_factory.evaluation.methods.methods import named_methods
    from tableverse_factory.evaluation.methods.sources import dropped_scenes, find_scenes

    cache = None if meshes_only else cache_folder()
    methods = named_methods(paths or [], method or [])
    sources = {name: find_scenes(path) for name, path in methods.items()}
    measured = [
        measure_method(name, _watched(its, name), epsilon_m, cache, dropped_scenes(methods[name]))
        for name, its in sources.items()
    ]
    if as_json:
        print(json.dumps({"epsilon_m": epsilon_m, "methods": [each.as_json() for each in measured]}, indent=1))
    else:
        _show_collisions(measured, epsilon_m)
    if any(scene.error for each in measured for scene in each.scenes):
        raise typer.Exit(1)


def _show_collisions(methods: "list[MethodCollisions]", epsilon_m: float) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.core.text import sanitize_line

    title = f"scenes in which two objects overlap by more than {1e3 * epsilon_m:g} mm"
    table = Table("method", box=None, pad_edge=False, title=title, title_justify="left")
    for name in ("scenes", "objects", "colliding %", "95 %", "on pieces %", "median mm", "deepest mm"):
        table.add_column(name, justify="right")
    for each in methods:
        depths = [1e3 * scene.depth_m for scene in each.measured] or [float("nan")]
        low, high = each.interval() or (float("nan"), float("nan"))
        interval = f"{100 * low:.0f}–{100 * high:.0f}"
        rates = _percent(each.rate()), interval, _percent(each.piece_rate())
        spread = f"{np.median(depths):.2f}", f"{max(depths):.2f}"
        counts = str(len(each.measured)), str(sum(scene.objects for scene in each.measured))
        table.add_row(sanitize_line(each.method, 40), *counts, *rates, *spread)
    Console(markup=False).print(table)
    for each in methods:
        if each.dropped:
            print(
                f"{sanitize_line(each.method, 40)}: {each.dropped} scenes that the factory dropped are not among them"
            )
        _print_first(
            f"not measured: {sanitize_line(each.method, 40)}: {sanitize_line(scene.name, 80)}: {sanitize_line(scene.error)}"
            for scene in each.scenes
            if scene.error
        )


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"


@evaluate.command("gpt-score")
def evaluate_gpt_score(
    out: Annotated[Path, typer.Option("--out", help="Folder for grids, answers and results.")],
    paths: Paths = None,
    method: Methods = None,
    reference: Reference = None,
    rounds: Rounds = 1,
    seed: Seed = 0,
    cell: Cell = 448,
    grids_only: Annotated[bool, typer.Option("--grids-only", help="Write the grids and ask nobody.")] = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Let a model mark every method's scenes against the real picture, columns shuffled.

    Writes grids/, answers/ (which `curate.judge=replay` reads again) and gpt-score.json. Only scenes that all methods
    have are asked about. Exit code 1 if a question got no valid answer.

    Example: `tableverse evaluate gpt-score --method ours=out --method midi=midi/ --reference pictures --out score
    --rounds 2 --set curate.judge=gemini --set curate.model=gemini-2.5-pro --set curate.key_env=GEMINI_API_KEY`
    """
    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.methods.comparison import check_shared, compare
    from tableverse_factory.evaluation.methods.grid_judges import grid_judge
    from tableverse_factory.evaluation.methods.methods import named_methods
    from tableverse_factory.evaluation.methods.score import ask_all, write_grids
    from tableverse_factory.models.services import Services

    comparison = compare(named_methods(paths or [], method or []), reference, cell)
    check_shared(comparison)
    for lacking, names in comparison.missing.items():
        print(f"{lacking} lacks {len(names)} scenes, e.g. {names[0]}: left out for all", file=sys.stderr)
    if grids_only:
        print(f"{write_grids(comparison, rounds, seed, out)} grids in {out / 'grids'}")
        return
    settings = load_config(config, overrides or [])
    judge = grid_judge(settings.curate, Services(cache_folder(), settings.asking))
    election = ask_all(comparison, judge, rounds, seed, out, lambda asked: _watched(asked, "judge"))
    _report_score(election, seed, out, as_json)
    if election.refused or not election.ballots:
        raise typer.Exit(1)


def _report_score(election: "VoteResults", seed: int, out: Path, as_json: bool) -> None:
    import json

    from tableverse_factory.core.storage.files import write_atomic
    from tableverse_factory.evaluation.methods.score import as_json as score_as_json

    text = json.dumps(score_as_json(election, seed), indent=1)
    write_atomic(out / "gpt-score.json", f"{text}\n".encode())
    if as_json:
        print(text)
    else:
        _show_score(election, seed)


def _show_score(election: "VoteResults", seed: int) -> None:
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.core.text import sanitize_line
    from tableverse_factory.evaluation.methods.score import interval_text, rank_by_column, results
    from tableverse_factory.evaluation.methods.vlm_vote import METRICS

    title = f"marks of 1 to 10 and mean rank, with 95 % intervals, from {len(election.ballots)} answers"
    table = Table("method", box=None, pad_edge=False, title=title, title_justify="left")
    for name in METRICS:
        table.add_column(name.replace("_", " "), justify="right")
    for method, by_metric in results(election, seed).items():
        table.add_row(sanitize_line(method, 40), *(interval_text(by_metric[metric]) for metric in METRICS))
    Console(markup=False).print(table)
    places = (f"{letter} {rank:.2f}" for letter, rank in rank_by_column(election).items())
    print(f"mean rank by column, whoever stood there: {', '.join(places)}")
    _print_first(
        f"no valid answer: {sanitize_line(refused.scene, 80)}, round {refused.round}: {sanitize_line(refused.reason)}"
        for refused in election.refused
    )


@evaluate.command("layout")
def evaluate_layout(
    truth: Annotated[
        Path,
        typer.Option(help="Folder of the truth: poses (*.json), synthetic captures, or scenes.", exists=True),
    ],
    paths: Paths = None,
    method: Methods = None,
    as_json: AsJson = False,
) -> None:
    """Compare layouts with the truth: positions, sizes, headings, support and containment kept.

    Exit code 1 if a scene that has a truth could not be compared.

    Example: `tableverse evaluate layout layouts --truth layouts/truth`, or `… layout out --truth captures`
    """
    import json
    from dataclasses import asdict

    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.evaluation.methods.comparison import shared_names
    from tableverse_factory.evaluation.methods.layout import compare_layouts, summary
    from tableverse_factory.evaluation.methods.methods import named_methods
    from tableverse_factory.evaluation.methods.sources import find_scenes
    from tableverse_factory.evaluation.methods.truth import find_truths

    truths = find_truths(truth)
    compared = {
        name: compare_layouts(shared_names(find_scenes(path)), truths, cache_folder())
        for name, path in named_methods(paths or [], method or []).items()
    }
    summaries = {name: summary(scenes) for name, scenes in compared.items()}
    if as_json:
        found = {name: {"summary": its, "scenes": [*map(asdict, compared[name])]} for name, its in summaries.items()}
        print(json.dumps(_without_nan(found), indent=1))
    else:
        _show_layouts(summaries, compared)
    if any(scene.error for scenes in compared.values() for scene in scenes):
        raise typer.Exit(1)


def _show_layouts(
    summaries: "dict[str, dict[str, float | None]]", compared: "Mapping[str, Sequence[SceneLayout]]"
) -> None:
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.evaluation.methods.layout import NOT_THERE

    table = Table("", box=None, pad_edge=False)
    for name in summaries:
        table.add_column(_one_line(name), justify="right")
    for row in next(iter(summaries.values())):
        cells = (its[row] for its in summaries.values())
        table.add_row(row, *("–" if cell is None else f"{cell:.4g}" for cell in cells))
    Console(markup=False).print(table)
    for name, scenes in compared.items():
        _print_first(
            _one_line(f"not compared: {name}: {scene.name}: {scene.error}")
            for scene in sorted(scenes, key=lambda its: its.error == NOT_THERE)
            if scene.error
        )


@evaluate.command("tables")
def evaluate_tables(
    folder: Annotated[
        Path, typer.Argument(help="Results: a subfolder for each method, and answers/.", exists=True, file_okay=False)
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for table1.md, table2.md and tables.json.")],
    answers: Annotated[
        Path | None,
        typer.Option(help="Answers that `evaluate gpt-score` recorded, if elsewhere.", exists=True, file_okay=False),
    ] = None,
    epsilon_m: Annotated[
        float, typer.Option("--epsilon", min=0.0, help="Depth that is no collision yet [m].")
    ] = 0.0001,
    pieces: Annotated[bool, typer.Option("--pieces", help="Also rates on convex pieces, in tables.json.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the bootstrap.")] = 0,
) -> None:
    """Write the paper's tables: methods against one another, and what each step of the factory leaves of collisions.

    The second is about methods that are datasets of ours, whose scenes keep their poses of every step. No model is
    asked: the judge's columns come from recorded answers. Exit code 1 if a scene could not be measured, or a recorded
    answer does not count.

    Example: `tableverse evaluate tables results --out results/tables`
    """
    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.evaluation.methods.tables import make_tables, write_tables

    tables = make_tables(folder, epsilon_m, seed, answers, cache_folder() if pieces else None)
    for path in write_tables(tables, out):
        print(path)
        if path.suffix == ".md":
            print(path.read_text())
    if not tables.complete:
        raise typer.Exit(1)


def _watched(items: Sequence[T], name: str) -> Iterator[T]:
    """The items one by one, counted on stderr."""
    from tableverse_factory.cli.progress_bar import counter

    with counter(_one_line(name), len(items)) as done:
        for item in items:
            yield item
            done()


def _print_first(lines: Iterable[str]) -> None:
    """The first lines, then how many more there are: a wrong folder would print one for each of its scenes."""
    found = list(lines)
    for line in found[:_SHOWN_LINES]:
        print(line)
    if len(found) > _SHOWN_LINES:
        print(f"… and {len(found) - _SHOWN_LINES} more like this; --json names all")


def _without_nan(value: Any) -> Any:
    """What is not finite becomes null: JSON knows no other word."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _one_line(text: str) -> str:
    from tableverse_factory.core.text import sanitize_line

    return sanitize_line(text, 300)
