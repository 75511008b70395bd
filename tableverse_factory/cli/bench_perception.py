"""`tableverse bench perception | placement | completion`: comparison of masks, poses and meshes with the truth."""

import math
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile
from tableverse_factory.cli.tables import print_figures, print_json
from tableverse_factory.core.text import sanitize_line

MOST_NAMED = 8  # captures without a truth that are named

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.completion import CompletionScore
    from tableverse_factory.evaluation.bench.perception import MaskScore
    from tableverse_factory.evaluation.bench.placement import PlacementError


def bench_perception(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder of captures, or one of them, with seg.png or masks.png as truth.", exists=True, file_okay=False
        ),
    ],
    detector: Annotated[
        Literal["ensemble", "geometric", "picture", "replay"], typer.Option(help="Detector to measure.")
    ] = "ensemble",
    weights: Annotated[
        str, typer.Option(metavar="FILE", help="Another .onnx file of our net, for ensemble and picture.")
    ] = "",
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare the objects found in each capture with the true ones: masks, counts, CPU time, containment.

    Containment needs a truth.json beside the capture (`tableverse synth`): precision and recall of its pairs.

    Example: `tableverse bench perception captures --detector geometric`
    """
    from tableverse_factory.cli.progress_bar import track_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.evaluation.bench.captures import list_captures, list_captures_lacking
    from tableverse_factory.evaluation.bench.perception import TRUTH_NAMES, bench_masks, merge_scores
    from tableverse_factory.sources.capture import COLOR_NAMES
    from tableverse_factory.sources.discovery import GROUND_TRUTH_NAME

    if weights and detector in ("geometric", "replay"):
        raise typer.BadParameter(f"--weights is for ensemble and picture: {detector} asks no net")
    chosen = [f"perceive.detector={detector}", *([f"perceive.detector_weights={weights}"] if weights else [])]
    total = len(list_captures(folder, TRUTH_NAMES, COLOR_NAMES))
    scores = list(track_progress("captures", bench_masks(folder, load_config(config, chosen)), total))
    if all(score.unread for score in scores):
        raise InputError(f"none of {len(scores)} captures could be read; the first: {scores[0].reason}")
    rows = [*scores, merge_scores(scores)]
    if untold := list_captures_lacking(folder, COLOR_NAMES, TRUTH_NAMES):
        names = [sanitize_line(path.name) for path in untold[:MOST_NAMED]]
        more = f" and {len(untold) - MOST_NAMED} more" if len(untold) > MOST_NAMED else ""
        print(f"without {' or '.join(TRUTH_NAMES)}: {', '.join(names)}{more}", file=sys.stderr)
    if as_json:
        *of_each, together = [asdict(row) | _derive_scores(row) for row in rows]
        print_json({"captures": of_each, "together": together})
    else:
        _show_masks(rows, detector)
        if list_captures(folder, [GROUND_TRUTH_NAME]):
            _show_placements(folder, (("replay", "carved"),), config, as_json=False)


def bench_placement(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder of captures, or one of them, with truth.json (`tableverse synth`).",
            exists=True,
            file_okay=False,
        ),
    ],
    detector: Annotated[
        str, typer.Option(help="Detector of the masks: replay (perfect masks) or geometric; both by default.")
    ] = "",
    meshes: Annotated[
        str, typer.Option(help="carved, or replay: the true meshes, turned and without size; both by default.")
    ] = "",
    config: ConfigFile = None,
    as_json: AsJson = False,
) -> None:
    """Compare position, heading and size of placed objects with the truth of synthetic captures.

    Headings are compared for objects whose true mesh looks alike at no other heading.

    Example: `tableverse bench placement captures`
    """
    from tableverse_factory.evaluation.bench.placement import MASKS, MESHES

    chosen = [(name, kind) for name in _select_known(detector, MASKS) for kind in _select_known(meshes, MESHES)]
    _show_placements(folder, tuple(chosen), config, as_json)


def bench_completion(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of scanned meshes; without it, twenty simple bodies and four vessels, in about a minute.",
            exists=True,
            file_okay=False,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the depth noise.")] = 0,
    view: Annotated[
        list[str] | None,
        typer.Option(metavar="AZIMUTH,ELEVATION", help="A camera's direction [degrees]; repeat it for others."),
    ] = None,
    error_mm: Annotated[
        float, typer.Option(min=0.0, max=50.0, help="Errors on the objects that agree over a few pixels, as gloss has.")
    ] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Compare single-view completions of meshes with the whole meshes, beside hull and height field.

    JSON holds `seed`, `error_mm`, `views` and `scores`, one of each mesh, view and method.

    Example: `tableverse bench completion --view 200,25 --error-mm 5` or `tableverse bench completion meshes`
    """
    from tableverse_factory.cli.progress_bar import track_progress
    from tableverse_factory.evaluation.bench.completion import VIEWS, bench_completion, read_solids

    views = [_parse_view(text) for text in view] if view else VIEWS
    meshes = read_solids(folder)
    of_meshes = bench_completion(meshes, seed, views, error_mm / 1e3)
    scores = [score for of_mesh in track_progress("meshes", of_meshes, len(meshes)) for score in of_mesh]
    if as_json:
        print_json({"seed": seed, "error_mm": error_mm, "views": views, "scores": scores})
    else:
        _show_completions(scores)


def _parse_view(text: str) -> tuple[float, float]:
    azimuth, _, elevation = text.partition(",")
    try:
        found = float(azimuth), float(elevation)
    except ValueError:
        found = math.nan, math.nan
    if not (math.isfinite(found[0]) and 5.0 <= found[1] <= 85.0):
        message = f"{text!r}: give azimuth and elevation in degrees, as in 200,25; elevation 5 to 85"
        raise typer.BadParameter(message, param_hint="--view")
    return found


def _show_completions(scores: list["CompletionScore"]) -> None:
    title = "mean and median IoU, Chamfer distance in mm; of hollow meshes IoU and share of the cavity that stays open"
    columns = ("method", "views", "IoU", "median", "mm", "hollow", "cavity", "size %", "CPU s")
    groups = {name: [s for s in scores if s.method == name] for name in ("hull", "height field")}
    ours = [score for score in scores if score.method.startswith("carved")]
    groups["carved, as chosen"] = ours
    groups |= {name: [s for s in ours if s.method == name] for name in sorted({s.method for s in ours})}
    print_figures(columns, ((name, len(its), *_completion_figures(its)) for name, its in groups.items()), title)
    hollow = sorted({score.mesh for score in scores if score.hollow})
    print(f"hollow: {', '.join(hollow) or 'none'}")


def _completion_figures(scores: list["CompletionScore"]) -> Iterator[str]:
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


def _select_known(name: str, known: tuple[str, ...]) -> tuple[str, ...]:
    if name and name not in known:
        raise typer.BadParameter(f"{name!r} is none of {', '.join(known)}")
    return (name,) if name else known


def _show_placements(folder: Path, ways: tuple[tuple[str, str], ...], config: Path | None, as_json: bool) -> None:
    from tableverse_factory.cli.progress_bar import track_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.evaluation.bench.captures import list_captures
    from tableverse_factory.evaluation.bench.placement import bench_placement
    from tableverse_factory.sources.discovery import GROUND_TRUTH_NAME

    found: dict[tuple[str, str], list[PlacementError]] = {way: [] for way in ways}
    total = len(list_captures(folder, [GROUND_TRUTH_NAME]))
    for of_capture in track_progress("captures", bench_placement(folder, load_config(config), ways), total):
        for way, entries in of_capture.items():
            found[way] += entries
    if as_json:
        rows = [{"masks": masks, "meshes": kind} | asdict(e) for (masks, kind), of in found.items() for e in of]
        print_json(rows)
        return
    for (masks, kind), entries in found.items():
        _show_way(f"masks by {masks}, meshes {kind}", entries)


def _show_way(title: str, entries: list["PlacementError"]) -> None:
    placed = [entry for entry in entries if entry.completion]
    kinds = {kind: [e for e in placed if e.completion == kind] for kind in sorted({e.completion for e in placed})}
    groups = {**(kinds if len(kinds) > 1 else {}), "all": placed}
    columns = ("completion", "n", "mm", "°", "turned", "size %", "fit mm", "mm/std", "°/std")
    rows = ((kind, len(of_kind), *_placement_figures(of_kind)) for kind, of_kind in groups.items())
    print_figures(columns, rows, f"{title}: median / 90 % of the errors of position, of heading where turned, and size")
    print(f"not placed: {len(entries) - len(placed)} of {len(entries)} true objects, hidden ones included")


def _placement_figures(entries: list["PlacementError"]) -> list[str]:
    """Format medians and 90th percentiles of the errors, also over their stated deviations."""
    import numpy as np

    def spread(values: list[float], *quantiles: int) -> str:
        known = np.array(values)[np.isfinite(values)]
        return "/".join(f"{v:.1f}" for v in np.percentile(known, quantiles)) if len(known) else "–"

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


def _derive_scores(row: "MaskScore") -> dict[str, object]:
    pairs = row.containment
    containment = asdict(pairs) | {"precision": pairs.precision, "recall": pairs.recall} if pairs else None
    scores = {name: getattr(row, name) for name in ("mean_iou", "recall", "overlap_f")}
    return {**scores, "containment": containment}


def _show_masks(rows: list["MaskScore"], detector: str) -> None:
    known = rows[-1].containment is not None
    columns = ["capture", "found", "true", "mean IoU", "recall@0.5", "overlap F", "CPU s"]
    lines = []
    for row in rows:
        figures = [f"{row.mean_iou:.3f}", f"{row.recall:.3f}", f"{row.overlap_f:.3f}", f"{row.cpu_s:.2f}"]
        pairs = row.containment
        counts = [f"{pairs.true}/{pairs.found}/{pairs.correct}" if pairs else ""] if known else []
        lines.append((row.name, row.found, row.truth, *figures, *counts, row.reason))
    print_figures([*columns, *(["contained: true/found/correct"] if known else [])], lines, f"masks by {detector}")
    total = rows[-1].containment
    if total is not None:
        shares = f"precision {total.precision:.3f}, recall {total.recall:.3f}".replace("nan", "-")
        print(f"containment: {shares} ({total.correct} of {total.found} found pairs correct, {total.true} true)")
