"""`tableverse bench segmenter`: how many pictures a second a model turns into masks."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from tableverse_factory.cli.options import AsJson


def bench_segmenter(
    pictures: Annotated[Path, typer.Argument(help="Folder of pictures, at any depth.", exists=True, file_okay=False)],
    weights: Annotated[str, typer.Option(help="`random`, a folder, or owner/name@revision of the hub.")] = "random",
    model: Annotated[Literal["large", "tiny"], typer.Option(help="Size of the model with random weights.")] = "large",
    device: Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="Where it runs.")] = "auto",
    batch: Annotated[list[int] | None, typer.Option(min=1, max=256, help="Pictures at a time; 8 and 32.")] = None,
    count: Annotated[int, typer.Option(min=1, max=100_000, help="Pictures per row.")] = 256,
    as_json: AsJson = False,
) -> None:
    """Turn pictures with ten boxes each into masks on disk, from the plain loop to the pipelined one.

    Example: `tableverse bench segmenter captures --model tiny --device cpu --batch 4 --count 16`
    """
    import json
    import tempfile
    from dataclasses import asdict

    from rich.console import Console
    from rich.table import Table

    from schemas.config import ModelsConfig
    from tableverse_factory.evaluation.bench.segmenter import bench_segmenter

    with tempfile.TemporaryDirectory() as out:
        measured = bench_segmenter(
            pictures, Path(out), weights, model, ModelsConfig(device=device), batch or (8, 32), count
        )
        rates = list(measured)
    if as_json:
        print(json.dumps([asdict(rate) for rate in rates], indent=2))
        return
    table = Table(box=None, pad_edge=False, title="SAM 2, ten boxes a picture, files to files", title_justify="left")
    table.add_column("")
    for name in ("precision", "pictures/s", "times", "GPU busy", "GPU memory GiB"):
        table.add_column(name, justify="right")
    for rate in rates:
        busy = "–" if rate.busy is None else f"{rate.busy:.0%}"
        memory = "–" if rate.peak_bytes is None else f"{rate.peak_bytes / 2**30:.1f}"
        times = rate.per_s / rates[0].per_s
        table.add_row(rate.setting.name, rate.setting.precision, f"{rate.per_s:.2f}", f"{times:.2f}", busy, memory)
    Console(markup=False).print(table)
