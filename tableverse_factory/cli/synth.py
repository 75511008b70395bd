"""`tableverse synth`: synthetic captures with known truth."""

from pathlib import Path
from typing import Annotated

import typer


def synth(
    out: Annotated[Path, typer.Argument(help="A new or empty folder, or one to go on with.")],
    scenes: Annotated[int, typer.Option("--scenes", "-n", min=1, help="How many captures.")] = 8,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Same seed, same bytes, whatever the number.")] = 0,
) -> None:
    """Make synthetic RGB-D captures of cluttered table-tops, with masks, detections and the truth.

    Scenes that are there already are kept, so the same command again goes on where it stopped.

    Example: `tableverse synth captures --scenes 24 --seed 7 && tableverse manifest captures --out images.parquet`
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from tableverse_factory.synth.synthesize import synthesize

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("scenes", total=scenes)

        def on_scene(folder: Path, made: bool) -> None:
            progress.advance(task)
            if not console.is_terminal:
                print(f"{folder} {'made' if made else 'was there'}", flush=True)

        folders = synthesize(out, scenes, seed, on_scene)
    print(f"{len(folders)} captures in {out}")
