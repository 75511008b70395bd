"""`tableverse bench`: measurements of the parts of the factory, those of the documentation."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.bench_cameras import bench_cameras
from tableverse_factory.cli.bench_cousins import bench_cousins
from tableverse_factory.cli.bench_cpu_time import bench_stages, bench_trajectories
from tableverse_factory.cli.bench_perception import bench_completion, bench_perception, bench_placement
from tableverse_factory.cli.bench_picture import bench_picture
from tableverse_factory.cli.bench_scale import bench_factory, bench_query
from tableverse_factory.cli.bench_soak import bench_soak
from tableverse_factory.cli.bench_twin import bench_twin
from tableverse_factory.cli.bench_warp import bench_warp
from tableverse_factory.cli.options import AsJson, ConfigFile, Epsilon
from tableverse_factory.cli.tables import print_figures, print_json
from tableverse_factory.core.cache_dir import get_cache_dir

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.decompose import PieceScore

bench = typer.Typer(name="bench", help="Measure the parts of the factory on your own data.", no_args_is_help=True)
bench.command("layout")(bench_stages)
bench.command("factory")(bench_factory)
bench.command("soak")(bench_soak)
bench.command("query")(bench_query)
bench.command("trajectories")(bench_trajectories)
bench.command("perception")(bench_perception)
bench.command("picture")(bench_picture)
bench.command("placement")(bench_placement)
bench.command("completion")(bench_completion)
bench.command("twin")(bench_twin)
bench.command("cameras")(bench_cameras)
bench.command("cousins")(bench_cousins)
bench.command("warp")(bench_warp)


Truth = Annotated[
    Path | None,
    typer.Option(help="Folder of files of the same names with the true poses.", exists=True, file_okay=False),
]
Methods = Annotated[
    str, typer.Option(help="Methods, separated by commas; by default all but `settle alone`, the settle stage alone.")
]
BurstPicture = Annotated[
    Path | None,
    typer.Option(help="Draw the methods side by side, on the layout that the first one bursts most, as a PNG file."),
]


@bench.command("lccr")
def bench_lccr(
    layouts: Annotated[Path, typer.Argument(help="Folder of layout files (*.json), or one of them.", exists=True)],
    truth: Truth = None,
    methods: Methods = "",
    most: Annotated[int | None, typer.Option(min=1, help="Most layouts, spread evenly over the folder.")] = None,
    epsilon_m: Epsilon = 0.0001,
    picture: BurstPicture = None,
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare methods that remove collisions: what collides, rests and moves, which relations hold, and the cost.

    Collisions are counted beyond --epsilon and beyond export.epsilon_m.

    Example: `tableverse synth demo --kind layouts && tableverse bench lccr demo/layouts --truth demo/truth`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.bench.ablation_picture import write_ablation
    from tableverse_factory.evaluation.bench.layouts import find_layouts
    from tableverse_factory.evaluation.bench.lccr import bench_lccr, summarize_scores
    from tableverse_factory.evaluation.bench.rectifiers import DEFAULT_METHODS

    paths = find_layouts(layouts, most)
    names = [name.strip() for name in methods.split(",")] if methods else list(DEFAULT_METHODS)
    settings = load_config(config)
    with count_progress("layouts", len(paths)) as done:
        scores = bench_lccr(paths, truth, settings, get_cache_dir(), names, lambda *_: done())
    if picture is not None:
        bursts = scores[names[0]].burst_speeds
        write_ablation(picture, paths[bursts.index(max(bursts))], names, settings, get_cache_dir())
    epsilons_m = sorted({epsilon_m, settings.export.epsilon_m})
    summaries = {name: summarize_scores(score, epsilons_m) for name, score in scores.items()}
    if as_json:
        print_json(summaries)
    else:
        measures = next(iter(summaries.values()))
        rows = ([name, *(_format_figure(values[name]) for values in summaries.values())] for name in measures)
        print_figures(["", *summaries], rows)


def _format_figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


@bench.command("decompose")
def bench_decompose(
    folder: Annotated[Path, typer.Argument(help="Folder of meshes.", exists=True, file_okay=False)],
    methods: Annotated[
        str, typer.Option(help="Separated by commas: coacd defaults, coacd, cut.")
    ] = "coacd defaults,coacd,cut",
    most: Annotated[int | None, typer.Option(min=1, help="Most meshes, spread evenly over the folder.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare methods of convex decomposition on the same meshes: time, pieces, volume, distance, open cavities.

    `faster` is the CPU time of the first method over that of each. CoACD at its defaults takes up to a minute a mesh.

    Example: `tableverse bench decompose meshes --most 8`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.evaluation.bench.completion import read_solids
    from tableverse_factory.evaluation.bench.decompose import bench_decompose, check_methods, summarize_pieces

    names = [name.strip() for name in methods.split(",")]
    check_methods(names)
    meshes = read_solids(folder, most)
    with count_progress("meshes", len(meshes)) as done:
        scores = bench_decompose(meshes, names, done)
    overall = summarize_pieces(scores, names)
    if as_json:
        print_json({"meshes": scores, "together": overall})
    else:
        _show_pieces([*scores, *overall])


def _show_pieces(scores: list["PieceScore"]) -> None:
    rows = []
    for s in scores:
        counts = (f"{s.cpu_s:.1f}", f"{s.faster:.1f}", s.pieces, f"{s.volume_ratio:.2f}")
        shares = (f"{100 * s.volume_error:.0f}", f"{100 * s.hausdorff:.1f}", f"{100 * s.cavity_kept:.0f}")
        rows.append((s.mesh, s.method, *counts, *shares))
    figures = ("CPU s", "faster", "pieces", "volume", "error %", "Hausdorff %", "cavity kept %")
    print_figures(("mesh", "method", *figures), rows)
    print("together: sums of CPU s and pieces, means of the rest; Hausdorff in % of the longest side of the mesh")
