"""`tableverse bench perception | placement | completion`: what is found in pictures, held against the truth."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile

if TYPE_CHECKING:
    from tableverse_factory.bench.completion import Score
    from tableverse_factory.bench.perception import MaskScore
    from tableverse_factory.bench.placement import Placement


def bench_perception(
    folder: Annotated[
        Path,
        typer.Argument(help="Folder of captures with seg.png or masks.png as truth.", exists=True, file_okay=False),
    ],
    detector: Annotated[
        str, typer.Option(help="Whose masks are measured: geometric, learned or replay.")
    ] = "geometric",
    weights: Annotated[str, typer.Option(metavar="FILE", help="The .onnx file of `learned`.")] = "",
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare the objects found in each capture with the true ones: masks, counts, time, and what lies in what.

    What lies in what is known of captures with a truth.json (`tableverse synth`): precision and recall of the pairs.

    Example: `tableverse bench perception captures --detector geometric`
    """
    import json
    from dataclasses import asdict

    from tableverse_factory.bench.perception import bench_masks, together
    from tableverse_factory.configuration import load_config

    chosen = [f"perceive.detector={detector}", *([f"perceive.detector_weights={weights}"] if weights else [])]
    scores = list(bench_masks(folder, load_config(config, chosen)))
    rows = [*scores, together(scores)]
    if as_json:
        print(json.dumps([asdict(row) | _derived(row) for row in rows], indent=2).replace("NaN", "null"))
    else:
        _show_masks(rows, detector)
        if any(folder.glob("*/truth.json")):
            _show_placements(folder, (("replay", "carved"),), config)


def bench_placement(
    folder: Annotated[
        Path,
        typer.Argument(help="Folder of captures with truth.json (`tableverse synth`).", exists=True, file_okay=False),
    ],
    detector: Annotated[
        str, typer.Option(help="Whose masks are used: replay (perfect ones), geometric; both without this.")
    ] = "",
    meshes: Annotated[
        str, typer.Option(help="carved, or replay: the true meshes, turned and without size; both without this.")
    ] = "",
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare where, how turned and how large objects are placed with the truth of synthetic captures.

    Headings are of objects without symmetry: whose true mesh, as it stands, looks alike at no other heading.

    Example: `tableverse bench placement captures`
    """
    from tableverse_factory.bench.placement import MASKS, MESHES

    chosen = [(name, kind) for name in _among(detector, MASKS) for kind in _among(meshes, MESHES)]
    _show_placements(folder, tuple(chosen), config, as_json)


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
    for name in ("views", "mean IoU", "median IoU", "Chamfer mm", "hollow IoU", "cavity kept", "size %", "CPU s"):
        table.add_column(name, justify="right")
    groups = {name: [s for s in scores if s.method == name] for name in ("hull", "height field")}
    ours = [score for score in scores if score.method.startswith("carved")]
    groups["carved, as chosen"] = ours
    groups |= {name: [s for s in ours if s.method == name] for name in sorted({s.method for s in ours})}
    for method, of_method in groups.items():
        table.add_row(method, str(len(of_method)), *_completion_figures(of_method))
    Console(markup=False, width=110).print(table)
    hollow = sorted({score.mesh for score in scores if score.hollow})
    print(f"hollow: {', '.join(hollow) or 'none'}")


def _completion_figures(scores: list["Score"]) -> Iterator[str]:
    """A dash where there is nothing to measure."""
    from statistics import mean, median

    if not scores:
        yield from "-------"
        return
    hollow = [score for score in scores if score.hollow]
    yield f"{mean(score.iou for score in scores):.3f}"
    yield f"{median(score.iou for score in scores):.3f}"
    yield f"{1e3 * mean(score.chamfer_m for score in scores):.1f}"
    yield f"{mean(score.iou for score in hollow):.3f}" if hollow else "-"
    yield f"{mean(score.cavity_kept for score in hollow):.2f}" if hollow else "-"
    yield f"{100 * mean(score.size_error for score in scores):.1f}"
    seconds = median(score.cpu_s for score in scores)
    yield f"{seconds:.2f}" if seconds > 0.0 else "-"


def _among(asked: str, known: tuple[str, ...]) -> tuple[str, ...]:
    if asked and asked not in known:
        raise typer.BadParameter(f"{asked!r} is none of {', '.join(known)}")
    return (asked,) if asked else known


def _show_placements(
    folder: Path, ways: tuple[tuple[str, str], ...], config: Path | None, as_json: bool = False
) -> None:
    import json
    from dataclasses import asdict

    from tableverse_factory.bench.placement import bench_placement
    from tableverse_factory.configuration import load_config

    found: dict[tuple[str, str], list[Placement]] = {way: [] for way in ways}
    for of_capture in bench_placement(folder, load_config(config), ways):
        for way, entries in of_capture.items():
            found[way] += entries
    if as_json:
        rows = [{"masks": masks, "meshes": kind} | asdict(e) for (masks, kind), of in found.items() for e in of]
        print(json.dumps(rows, indent=2).replace("NaN", "null"))
        return
    for (masks, kind), entries in found.items():
        _show_way(f"masks by {masks}, meshes {kind}", entries)


def _show_way(title: str, entries: list["Placement"]) -> None:
    from rich.console import Console
    from rich.table import Table

    placed = [entry for entry in entries if entry.completion]
    table = Table("completion", box=None, pad_edge=False, title=title, title_justify="left")
    for name in ("objects", "position mm", "heading °", "of", "size %", "residual mm", "position/std", "heading/std"):
        table.add_column(name, justify="right")
    kinds = {kind: [e for e in placed if e.completion == kind] for kind in sorted({e.completion for e in placed})}
    for kind, of_kind in {**(kinds if len(kinds) > 1 else {}), "all": placed}.items():
        table.add_row(kind, str(len(of_kind)), *_placement_figures(of_kind))
    Console(markup=False).print(table)
    print(f"not placed: {len(entries) - len(placed)} of {len(entries)} true objects, hidden ones counted")


def _placement_figures(entries: list["Placement"]) -> list[str]:
    """Medians and 90th percentiles of the errors; medians of errors over what was said of them."""
    import numpy as np

    def spread(values: list[float], *quantiles: int) -> str:
        known = np.array(values)[np.isfinite(values)]
        return " / ".join(f"{v:.1f}" for v in np.percentile(known, quantiles)) if len(known) else "–"

    turned = [e for e in entries if e.symmetry == 1]
    return [
        spread([1e3 * e.position_error_m for e in entries], 50, 90),
        spread([float(np.degrees(e.heading_error_rad)) for e in turned], 50, 90),
        str(len(turned)),
        spread([100 * e.size_error for e in entries], 50, 90),
        spread([1e3 * e.residual_m for e in entries], 50),
        spread([e.position_error_m / e.position_std_m for e in entries], 50, 90),
        spread([e.heading_error_rad / e.heading_std_rad for e in entries if e.heading_std_rad > 0], 50, 90),
    ]


def _derived(row: "MaskScore") -> dict[str, object]:
    """What follows from the counts of a row; `containment` with its shares."""
    from dataclasses import asdict

    pairs = row.containment
    shares = {"precision": pairs.precision, "recall": pairs.recall} if pairs else {}
    return {
        "mean_iou": row.mean_iou,
        "recall": row.recall,
        "overlap_f": row.overlap_f,
        "containment": asdict(pairs) | shares if pairs else None,
    }


def _show_masks(rows: list["MaskScore"], detector: str) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"masks by {detector}", box=None, pad_edge=False, title_justify="left")
    table.add_column("capture")
    for name in ("found", "true", "mean IoU", "recall@0.5", "overlap F", "CPU s"):
        table.add_column(name, justify="right")
    known = rows[-1].containment is not None
    if known:
        table.add_column("in: true/said/right", justify="right")
    for row in rows:
        figures = [f"{row.mean_iou:.3f}", f"{row.recall:.3f}", f"{row.overlap_f:.3f}", f"{row.cpu_s:.2f}"]
        pairs = row.containment
        counts = [f"{pairs.true}/{pairs.said}/{pairs.right}" if pairs else ""] if known else []
        table.add_row(row.name, str(row.found), str(row.truth), *figures, *counts, row.reason)
    Console(markup=False, width=110).print(table)
    total = rows[-1].containment
    if total is not None:
        shares = f"precision {total.precision:.3f}, recall {total.recall:.3f}".replace("nan", "-")
        print(f"what lies in what: {shares} ({total.right} right of {total.said} said, {total.true} true)")
