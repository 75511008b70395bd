"""`tableverse synth`: synthetic captures or layouts with ground truth."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from tableverse_factory.cli.options import require_local_path


def synth(
    out: Annotated[
        Path,
        typer.Argument(metavar="OUT", callback=require_local_path, help="A new or empty folder, or one to go on with."),
    ],
    scenes: Annotated[int, typer.Option("--scenes", "-n", min=1, metavar="N", help="How many.")] = 8,
    seed: Annotated[
        int, typer.Option("--seed", min=0, metavar="N", help="Same seed, same bytes, whatever the number.")
    ] = 0,
    kind: Annotated[
        Literal["captures", "layouts"],
        typer.Option(help="RGB-D captures, or layouts: meshes and poses under registration noise."),
    ] = "captures",
) -> None:
    """Make synthetic captures, or layouts, with known truth.

    Captures are RGB-D pictures of cluttered table-tops with masks, detections and the truth. `--kind layouts` makes
    the same scenes as layout files, with the collisions of real registrations, and the true resting poses of the
    objects: OUT/layouts, OUT/meshes, OUT/truth. Existing scenes are kept, so the same command again resumes.

    Example: `tableverse synth captures --scenes 24 --seed 7 && tableverse manifest captures --out images.parquet`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.text import pluralize
    from tableverse_factory.sources.synthetic.layout import synthesize_layouts
    from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

    with count_progress("scenes", scenes) as done:
        make = synthesize_captures if kind == "captures" else synthesize_layouts
        made = make(out, scenes, seed, lambda *_: done())
    print(f"{pluralize(len(made), kind.removesuffix('s'))} in {out}")
