"""`tableverse bench perception | placement | completion`: what is found in pictures, held against the truth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile

if TYPE_CHECKING:
    from tableverse_factory.bench.perception import MaskScore


def bench_perception(
    folder: Annotated[
        Path,
        typer.Argument(help="Folder of captures with seg.png or masks.png as truth.", exists=True, file_okay=False),
    ],
    detector: Annotated[str, typer.Option(help="Whose masks are measured: geometric or replay.")] = "geometric",
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare the objects found in each capture with the true ones: masks, counts, time.

    Example: `tableverse bench perception captures --detector geometric`
    """
    import json
    from dataclasses import asdict

    from tableverse_factory.bench.perception import bench_masks, together
    from tableverse_factory.configuration import load_config

    scores = list(bench_masks(folder, load_config(config, [f"perceive.detector={detector}"])))
    rows = [*scores, together(scores)]
    if as_json:
        print(json.dumps([asdict(row) | {"mean_iou": row.mean_iou, "recall": row.recall} for row in rows], indent=2))
    else:
        _show_masks(rows, detector)
        if any(folder.glob("*/truth.json")):
            _show_placements(folder, "replay", config)


def bench_placement(
    folder: Annotated[
        Path,
        typer.Argument(help="Folder of captures with truth.json (`tableverse synth`).", exists=True, file_okay=False),
    ],
    detector: Annotated[str, typer.Option(help="Whose masks are used: replay (perfect ones) or geometric.")] = "replay",
    config: ConfigFile = None,
) -> None:
    """Compare where and how large objects are placed with the truth of synthetic captures.

    Example: `tableverse bench placement captures`
    """
    _show_placements(folder, detector, config)


def bench_completion(
    folder: Annotated[Path, typer.Argument(help="Folder of scanned meshes.", exists=True, file_okay=False)],
    seed: Annotated[int, typer.Option(min=0, help="Of the depth's noise.")] = 0,
) -> None:
    """Compare single-view completions of scanned meshes with the whole meshes, hull and height field beside them.

    Example: `tableverse bench completion meshes`
    """
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.bench.completion import bench_completion

    scores = bench_completion(folder, seed)
    table = Table("method", box=None, pad_edge=False, title="two views of each mesh", title_justify="left")
    for name in ("mean IoU", "median IoU", "Chamfer mm", "size %"):
        table.add_column(name, justify="right")
    groups = {name: [s for s in scores if s.method == name] for name in dict.fromkeys(s.method for s in scores)}
    groups["carved, all"] = [score for score in scores if score.method.startswith("carved")]
    for method, of_method in groups.items():
        ious = sorted(score.iou for score in of_method)
        chamfer_mm = 1e3 * sum(score.chamfer_m for score in of_method) / len(of_method)
        size = 100 * sum(score.size_error for score in of_method) / len(of_method)
        figures = (sum(ious) / len(ious), ious[len(ious) // 2], chamfer_mm, size)
        table.add_row(method, *(f"{figure:.3f}" for figure in figures))
    Console(markup=False).print(table)


def _show_placements(folder: Path, detector: str, config: Path | None) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.bench.placement import bench_placement
    from tableverse_factory.configuration import load_config

    placements = bench_placement(folder, load_config(config, [f"perceive.detector={detector}"]))
    placed = [entry for entry in placements if entry.completion]
    table = Table(
        "completion", box=None, pad_edge=False, title=f"placed from masks by {detector}", title_justify="left"
    )
    for name in ("objects", "position mm", "p90", "size %", "p90"):
        table.add_column(name, justify="right")
    kinds = {kind: [e for e in placed if e.completion == kind] for kind in sorted({e.completion for e in placed})}
    for kind, entries in {**kinds, "all": placed}.items():
        position = np.array([1e3 * entry.position_error_m for entry in entries])
        size = np.array([100 * entry.size_error for entry in entries])
        spread = [np.percentile(values, q) for values in (position, size) for q in (50, 90) if len(values)]
        table.add_row(kind, str(len(entries)), *(f"{value:.1f}" for value in spread))
    Console(markup=False).print(table)
    print(f"not placed: {len(placements) - len(placed)} of {len(placements)} true objects, hidden ones counted")


def _show_masks(rows: list["MaskScore"], detector: str) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"masks by {detector}", box=None, pad_edge=False, title_justify="left")
    table.add_column("capture")
    for name in ("found", "true", "mean IoU", "recall@0.5", "overlap F", "CPU s"):
        table.add_column(name, justify="right")
    for row in rows:
        figures = (f"{row.mean_iou:.3f}", f"{row.recall:.3f}", f"{row.overlap_f:.3f}", f"{row.cpu_s:.2f}")
        table.add_row(row.name, str(row.found), str(row.truth), *figures, row.reason)
    Console(markup=False).print(table)
