"""`tableverse bench picture`: bare pictures against the depth and masks that a sensor and people gave them."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile, Overrides
from tableverse_factory.cli.tables import print_figures, print_json

if TYPE_CHECKING:
    from tableverse_factory.evaluation.bench.perception import MaskScore
    from tableverse_factory.evaluation.bench.picture import PictureScore, PictureSummary


def bench_picture(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder of captures, or one of them; only their colour is given to the net.",
            exists=True,
            file_okay=False,
        ),
    ],
    other: Annotated[
        Path | None, typer.Option(help="Folder of pictures that show no table-top.", exists=True, file_okay=False)
    ] = None,
    focal: Annotated[bool, typer.Option("--focal", help="Give the net the focal length of camera.json too.")] = False,
    shapes: Annotated[
        bool, typer.Option("--shapes", help="Compare the proportions of the shapes with those of the sensor's too.")
    ] = False,
    sheet: Annotated[
        bool, typer.Option("--sheet", help="Measure by a sheet of A4 on the table instead of a distance.")
    ] = False,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """Compare depth, table, scale and objects found in the colour of captures with their depth and masks.

    One scale is taken out of the depth error; measured, it is that of one distance which the sensor tells, or with
    --sheet of a sheet of A4, which tells the focal length too. Masks are compared where there is a seg.png or
    masks.png, shapes by their height over their width. Of the folder --other the pictures are listed that are not
    dropped.

    Example: `tableverse bench picture captures`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.evaluation.bench.picture import bench_other_pictures, bench_pictures, summarize_pictures

    settings = load_config(config, overrides or [])
    with count_progress("pictures") as done:
        scores = list(bench_pictures(folder, settings, focal, done.update, with_shapes=shapes, with_sheet=sheet))
    if all(score.unread for score in scores):
        raise InputError(f"none of {len(scores)} captures could be read; the first: {scores[0].reason}")
    total = summarize_pictures(scores)
    others = dict(bench_other_pictures(other, settings)) if other else {}
    if as_json:
        print_json({"pictures": [asdict(score) for score in scores], "all": asdict(total), "other": others})
        return
    _show_scores(scores, total)
    if others:
        kept = [name for name, reason in others.items() if not reason]
        print(f"without a table: {len(others) - len(kept)} of {len(others)} dropped; kept: {', '.join(kept) or 'none'}")


def _show_scores(scores: list["PictureScore"], total: "PictureSummary") -> None:
    geometry, masks = ("depth %", "measured %", "plane °", "scale %", "σ %"), ("mean IoU", "recall@0.5", "overlap F")
    columns = ("picture", *geometry, *masks, "CPU s", "dropped")
    rows: list[tuple[object, ...]] = []
    for s in scores:
        scale = math.expm1(-s.log_scale)
        figures = (100 * s.depth_error, 100 * s.measured_error, s.plane_deg, 100 * scale, 100 * s.scale_sigma)
        rows.append((s.name, *map(_format, figures), *_format_masks(s.masks), f"{s.cpu_s:.2f}", s.reason))
    depth, measured, scale = (100 * share for share in (total.depth_error, total.measured_error, total.scale_error))
    figures = (depth, measured, total.plane_deg, scale, math.nan)
    rows.append(("all", *map(_format, figures), *_format_masks(total.masks), f"{total.cpu_s:.2f}", f"{total.dropped}"))
    note = (
        "depth error in the mean, one scale taken out; in the median what is left of it where one length was measured"
    )
    print_figures(columns, rows, f"{note}, angle, scale and CPU s")
    if total.unread:
        print(f"{total.unread} captures could not be read: their rows say why")
    if shapes := [score.shapes for score in scores if score.shapes is not None]:
        compared, objects = sum(len(s.proportions) for s in shapes), sum(s.objects for s in shapes)
        error = _format(100 * total.proportion_error)
        print(f"height over width off by {error} % in the median of {compared} of the sensor's {objects} objects")
    print(f"scale within one stated standard deviation: {_format(100 * total.within_sigma)} % of pictures")


def _format(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.1f}"


def _format_masks(masks: "MaskScore | None") -> tuple[str, str, str]:
    if masks is None:
        return "", "", ""
    return f"{masks.mean_iou:.3f}", f"{masks.recall:.3f}", f"{masks.overlap_f:.3f}"
