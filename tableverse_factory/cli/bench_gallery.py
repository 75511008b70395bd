"""`tableverse bench gallery`: what a gallery of many scenes costs to make, and to open."""

from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.options import AsJson


def bench_gallery(
    out: Annotated[Path, typer.Argument(help="A dataset.", exists=True, file_okay=False)],
    scenes: Annotated[
        int, typer.Option(min=0, help="Copy its scenes, whole, until there are so many; 0 takes it as it is.")
    ] = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that draw.")] = 2,
    renders: Annotated[int | None, typer.Option(min=0, help="As in `tableverse report`.")] = None,
    films: Annotated[int | None, typer.Option(min=0, help="As in `tableverse report`.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure a gallery: seconds, CPU per scene, bytes of its first page, and the time until a browser shows it.

    The copies take as much room as the scenes do, some 5 MB each, below TMPDIR (/tmp by default), and are removed
    afterwards, also where the command is stopped. The browser is the system's Chromium, driven by playwright where
    that is installed.

    Example: `tableverse bench gallery out --scenes 2000`
    """
    import json
    import tempfile
    from dataclasses import asdict

    from tableverse_factory.cli.cleanup_on_sigterm import orderly_end
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.evaluation.bench.gallery import SHARD_SIZE, bench_gallery, write_copies

    with orderly_end(), tempfile.TemporaryDirectory(prefix="tableverse-bench-") as folder:
        source = out
        if scenes:
            source = Path(folder) / "out"
            with counter("shards", -(-scenes // SHARD_SIZE)) as done:
                write_copies(out, source, scenes, done)
        cost = bench_gallery(source, Path(folder) / "gallery", jobs, renders, films)
    if as_json:
        print(json.dumps(asdict(cost), indent=2))
        return
    paint = "–" if cost.first_paint_ms is None else f"{cost.first_paint_ms:.0f} ms"
    rows = {
        "scenes": f"{cost.scenes}, {cost.renders} of them drawn from every side",
        "made in": f"{cost.seconds:.1f} s by {cost.jobs} processes",
        "CPU per scene": f"{cost.cpu_ms:.1f} ms",
        "first page": f"{cost.first_page_bytes / 1e6:.2f} MB at most, with what the filters load",
        "first paint": paint,
        "whole gallery": f"{cost.total_bytes / 1e6:.0f} MB",
    }
    width = max(map(len, rows))
    for name, value in rows.items():
        print(f"{name.ljust(width)}  {value}")
