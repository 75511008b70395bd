"""`tableverse stats`: statistics of a dataset as one figure and as JSON."""

from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.options import AsJson, BuiltOut, require_local_path


def stats(
    out: BuiltOut,
    dest: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FOLDER",
            callback=require_local_path,
            help="Folder of the files; by default OUT-statistics beside the dataset.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Draw the overview of a dataset, or print it as JSON.

    One figure as PNG and SVG: scenes, categories, their long tail, masses, relations, the funnel; and the counts.

    Example: `tableverse stats out --out figures && xdg-open figures/overview.png`
    """
    import json

    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.viz.destination import choose_destination
    from tableverse_factory.viz.overview.write import make_report, write_statistics

    dataset = open_dataset(out)
    if as_json:
        print(json.dumps(make_report(dataset), indent=1, sort_keys=True, allow_nan=False))
        return
    for path in write_statistics(dataset, dest or choose_destination(out, "statistics")):
        print(path)
