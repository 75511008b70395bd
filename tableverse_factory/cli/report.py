"""`tableverse report`: a gallery that opens from disk."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer


def report(
    out: Annotated[str, typer.Argument(help="The dataset: OUT of `tableverse build`, finished or not.")],
    dest: Annotated[
        Path | None,
        typer.Option(help="Folder of the gallery; OUT-gallery, beside the dataset, by default; of s3://… in this one."),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes that draw; one per CPU by default.")] = None,
) -> None:
    """Write a gallery as static HTML: the funnel, statistics, and every scene beside its photograph.

    Example: `tableverse report out && xdg-open out-gallery/index.html`
    """
    from rich.console import Console
    from rich.progress import Progress

    from tableverse_factory.dataset import open_dataset
    from tableverse_factory.report.gallery import default_dest, not_drawn, write_gallery
    from tableverse_factory.text import printable

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("drawing", total=None)
        index = write_gallery(
            open_dataset(out),
            dest or default_dest(out),
            jobs or os.cpu_count() or 1,
            lambda done, total: progress.update(bar, completed=done, total=total),
        )
    problems = not_drawn(index)
    if problems:
        first = ": ".join(next(iter(problems.items())))
        print(f"could not open or draw {len(problems)} scenes, the first: {printable(first, 300)}", file=sys.stderr)
    print(index)
