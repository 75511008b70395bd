"""`tableverse bench twin`: exported scenes against the photographs that they were made from."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile, Jobs, Overrides
from tableverse_factory.cli.tables import print_figures, print_json

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.twin import TwinScore


def bench_twin(
    captures: Annotated[Path, typer.Argument(help="Folder of captures, or one of them.", exists=True, file_okay=False)],
    dataset: Annotated[
        str, typer.Option(metavar="OUT", help="Dataset of these captures; by default their scenes are computed.")
    ] = "",
    pictures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", file_okay=False, help="Write photograph, twin and difference of each side by side."
        ),
    ] = None,
    jobs: Jobs = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compare the scene of each capture with its photograph, drawn from the same camera.

    `twin` is the mean silhouette IoU of the things in the photograph, 0 for a lost one; `silhouette` its median. Things
    are those of seg.png or masks.png, else those that were perceived. Depth errors and CIEDE2000 colour differences are
    medians of the things' medians, relations those of the photograph that hold in the scene.

    Example: `tableverse bench twin captures --pictures twins`
    """
    from tableverse_factory.cli.progress_bar import track_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.process_pool import count_available_cpus, parallel_map
    from tableverse_factory.evaluation.bench.twin import find_captures, measure_twin, summarize_twins

    settings = load_config(config, overrides or [])
    rows = find_captures(captures, settings, dataset)
    measure = partial(measure_twin, config=settings, dataset=dataset, pictures=pictures)
    measured = parallel_map(measure, rows, jobs or count_available_cpus(), "compares twins")
    scores = list(track_progress("captures", measured, len(rows)))
    if as_json:
        of_each = [asdict(score) | {"number": score.number} for score in scores]
        print_json({"captures": of_each, "together": summarize_twins(scores)})
    else:
        _show_twins(scores)


def _show_twins(scores: "list[TwinScore]") -> None:
    from tableverse_factory.evaluation.bench.twin import summarize_twins

    rows = [_format_row(score.name, [score], score.reason) for score in scores]
    errors = ("twin", "silhouette", "depth mm", "ΔE", "explained")
    columns = ("capture", "things", "lost", "extra", *errors, "support", "inside", "")
    print_figures(columns, [*rows, _format_row("all", scores)], "things of seg.png or masks.png, else as perceived (*)")
    whole = summarize_twins(scores)
    print(f"{whole['scenes']:.0f} of {whole['captures']:.0f} captures have a scene")


def _format_row(name: str, scores: "list[TwinScore]", reason: str = "") -> tuple[str, ...]:
    from tableverse_factory.evaluation.bench.twin import summarize_twins

    its = summarize_twins(scores)
    counts = [f"{its[key]:.0f}" for key in ("things", "lost", "extra")]
    counts[0] += "" if all(score.truth for score in scores) or len(scores) > 1 else "*"
    depth, color = 1e3 * its["depth_error_m"], its["color_difference"]
    figures = [f"{its['twin']:.3f}", f"{its['silhouette_iou']:.3f}", f"{depth:.1f}", f"{color:.1f}"]
    figures.append(f"{its['explained_area']:.3f}")
    kept = [f"{its[f'{kind}_kept']:.0f}/{its[kind]:.0f}" for kind in ("supports", "containments")]
    return name, *counts, *(figure.replace("nan", "–") for figure in figures), *kept, reason[:60]
