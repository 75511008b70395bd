"""`tableverse bench`: measurements of the factory's parts, the same as those in the documentation."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.bench_gallery import bench_gallery
from tableverse_factory.cli.bench_perception import bench_completion, bench_perception, bench_placement
from tableverse_factory.cli.bench_scale import bench_factory, bench_query
from tableverse_factory.cli.bench_segmenter import bench_segmenter
from tableverse_factory.cli.bench_stages import bench_stages
from tableverse_factory.cli.bench_trajectories import bench_trajectories
from tableverse_factory.cli.options import AsJson, ConfigFile

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.composites import CompositeScore
    from tableverse_factory.evaluation.bench.decompose import PieceScore

bench = typer.Typer(name="bench", help="Measure the factory's parts on your own data.", no_args_is_help=True)
bench.command("layout")(bench_stages)
bench.command("factory")(bench_factory)
bench.command("gallery")(bench_gallery)
bench.command("query")(bench_query)
bench.command("trajectories")(bench_trajectories)
bench.command("perception")(bench_perception)
bench.command("placement")(bench_placement)
bench.command("completion")(bench_completion)
bench.command("segmenter")(bench_segmenter)


Truth = Annotated[
    Path | None,
    typer.Option(help="Folder of files of the same names: the true poses.", exists=True, file_okay=False),
]
Methods = Annotated[
    str, typer.Option(help="Separated by commas; without this all but `settle alone`, the settle stage by itself.")
]
Epsilon = Annotated[
    float, typer.Option("--epsilon", min=0.0, help="Depth that is no collision yet [m]; export.epsilon_m too.")
]
BurstPicture = Annotated[
    Path | None,
    typer.Option(help="Draw the methods side by side on the layout that the first one makes burst most: a PNG."),
]


@bench.command("lccr")
def bench_lccr(
    layouts: Annotated[Path, typer.Argument(help="Folder of layout files, *.json, or one of them.", exists=True)],
    truth: Truth = None,
    methods: Methods = "",
    most: Annotated[int | None, typer.Option(min=1, help="At most so many layouts, spread over the folder.")] = None,
    epsilon_m: Epsilon = 0.0001,
    picture: BurstPicture = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare ways to make layouts collision-free: what still collides, rests, moved, is kept, and what it cost.

    Example: `tableverse synth demo --kind layouts && tableverse bench lccr demo/layouts --truth demo/truth`
    """
    import json

    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.bench.ablation import write_ablation
    from tableverse_factory.evaluation.bench.layouts import layout_files
    from tableverse_factory.evaluation.bench.lccr import bench_lccr, summary
    from tableverse_factory.evaluation.bench.rectifiers import USUAL

    paths = layout_files(layouts, most)
    names = [name.strip() for name in methods.split(",")] if methods else list(USUAL)
    settings = load_config(config)
    with counter("layouts", len(paths)) as done:
        scores = bench_lccr(paths, truth, settings, cache_folder(), names, lambda *_: done())
    if picture is not None:
        bursts = scores[names[0]].burst_speeds
        write_ablation(picture, paths[bursts.index(max(bursts))], names, settings, cache_folder())
    epsilons_m = sorted({epsilon_m, settings.export.epsilon_m})
    summaries = {name: summary(score, epsilons_m) for name, score in scores.items()}
    if as_json:
        print(json.dumps(summaries, indent=2))
    else:
        _show(summaries)


def _show(summaries: dict[str, dict[str, float | None]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", box=None, pad_edge=False)
    for name in summaries:
        table.add_column(name, justify="right", no_wrap=True)
    rows = list(next(iter(summaries.values())))
    for row in rows:
        table.add_row(row, *(_cell(values[row]) for values in summaries.values()))
    # A table that is wider than the terminal is better read in a file than broken into pieces.
    width = max(map(len, rows)) + sum(max(len(name), 6) + 2 for name in summaries)
    Console(markup=False, width=max(width, Console().width)).print(table)


def _cell(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


@bench.command("composites")
def bench_composites(
    seed: Annotated[int, typer.Option(min=0, help="Decides the shapes and where things are dropped.")] = 0,
    picture: Annotated[Path | None, typer.Option(help="Draw three of them, as seen and in the end: a PNG.")] = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Fill synthetic vessels with 1 to 12 things: how many find room, and how many are in there when all is at rest.

    Example: `tableverse bench composites --picture composite.png`
    """
    import json
    from dataclasses import asdict

    from tableverse_factory.cli.cache import cache_folder
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.bench.composites import bench_composites, cases, write_picture

    settings = load_config(config)
    with counter("composites", cases()) as done:
        scores = bench_composites(seed, settings, cache_folder(), done)
    if picture is not None:
        write_picture(picture, seed, settings, cache_folder())
    if as_json:
        print(json.dumps([asdict(score) for score in scores], indent=2))
    else:
        _show_composites(scores)


def _show_composites(scores: list["CompositeScore"]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("container", "content", box=None, pad_edge=False)
    for name in ("asked", "inside", "kept at rest", "assembly CPU s", "settling CPU s"):
        table.add_column(name, justify="right")
    for score in scores:
        counts = (str(score.asked), str(score.inside), str(score.kept) if score.at_rest else "never at rest")
        table.add_row(score.container, score.content, *counts, f"{score.assembly_s:.2f}", f"{score.settling_s:.2f}")
    totals = (sum(s.asked for s in scores), sum(s.inside for s in scores), sum(s.kept for s in scores))
    seconds = (sum(s.assembly_s for s in scores), sum(s.settling_s for s in scores))
    table.add_row("all", "", *map(str, totals), *(f"{value:.2f}" for value in seconds))
    Console(markup=False).print(table)


@bench.command("decompose")
def bench_decompose(
    folder: Annotated[Path, typer.Argument(help="Folder of meshes.", exists=True, file_okay=False)],
    methods: Annotated[
        str, typer.Option(help="Separated by commas: coacd defaults, coacd, cut.")
    ] = "coacd defaults,coacd,cut",
    most: Annotated[int | None, typer.Option(min=1, help="At most so many meshes, spread over the folder.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare methods of convex decomposition on the same meshes: time, pieces, volume, distance, open cavities.

    `faster` is the CPU time of the first method over that of each. CoACD at its defaults takes up to a minute a mesh.

    Example: `tableverse bench decompose meshes --most 8`
    """
    import json
    from dataclasses import asdict

    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.evaluation.bench.decompose import bench_decompose, mesh_files, together

    names = [name.strip() for name in methods.split(",")]
    files = mesh_files(folder, most)
    with counter("meshes", len(files)) as done:
        scores = bench_decompose(files, names, done)
    overall = together(scores, names)
    if as_json:
        shown = {"meshes": scores, "together": overall}
        print(json.dumps({key: [asdict(score) for score in rows] for key, rows in shown.items()}, indent=2))
    else:
        _show_pieces([*scores, *overall])


def _show_pieces(scores: list["PieceScore"]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("mesh", "method", box=None, pad_edge=False)
    for name in ("CPU s", "faster", "pieces", "volume", "error %", "Hausdorff %", "cavity kept %"):
        table.add_column(name, justify="right")
    for s in scores:
        figures = (f"{s.cpu_s:.1f}", f"{s.faster:.1f}", str(s.pieces), f"{s.volume_ratio:.2f}")
        shares = (f"{100 * s.volume_error:.0f}", f"{100 * s.hausdorff:.1f}", f"{100 * s.cavity_kept:.0f}")
        table.add_row(s.mesh, s.method, *figures, *shares)
    Console(markup=False).print(table)
    print("together: CPU s and pieces in sum, all else in the mean; Hausdorff in % of the mesh's longest side")
