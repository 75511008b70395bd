"""`tableverse build`: from the image manifest to the dataset; the same command again goes on."""

from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.cache import cache_folder

if TYPE_CHECKING:
    from workers.build import Summary

SOME_FAILED = 3


class ExecutorName(StrEnum):
    """Where the stages run."""

    LOCAL = "local"
    RAY = "ray"


def build(
    manifest: Annotated[Path, typer.Argument(help="Image manifest (Parquet), from `tableverse manifest`.")],
    out: Annotated[Path, typer.Argument(help="Folder of the dataset; begun before, the build goes on.")],
    config: Annotated[Path | None, typer.Option("--config", help="YAML with the keys that differ.")] = None,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value, may repeat.")] = None,
    executor: Annotated[ExecutorName, typer.Option(help="One process, or Ray.")] = ExecutorName.RAY,
    workers: Annotated[int | None, typer.Option(min=1, help="Calls in flight on Ray; one per CPU by default.")] = None,
    address: Annotated[
        str | None, typer.Option(envvar="RAY_ADDRESS", help="A running Ray cluster: auto or HOST:PORT.")
    ] = None,
    metrics: Annotated[
        Path | None, typer.Option(help="Keep figures for Prometheus in this file (docs/monitoring.md).")
    ] = None,
) -> None:
    """Build the dataset, or go on with it after whatever stopped it.

    Exit code 0: every scene is accounted for and none failed; 3: some failed (see `tableverse failures`);
    1: the build cannot go on; 130 or 143: stopped by Ctrl-C or SIGTERM.

    Example: `tableverse build images.parquet out --workers 2 --set run.seed=7`
    """
    from rich.console import Console

    from tableverse_factory.cli.progress import Progress
    from tableverse_factory.configuration import load_config
    from workers.build import Request, run_build
    from workers.metrics import MetricsFile, dataset_name
    from workers.telemetry import Display, Displays

    request = Request(
        manifest=manifest,
        out=out,
        config=load_config(config, overrides or []),
        cache_dir=cache_folder(),
        executor=executor.value,
        workers=workers,
        address=address,
    )
    with ExitStack() as shown:
        displays: list[Display] = [shown.enter_context(Progress(Console(stderr=True)))]
        if metrics is not None:
            displays.append(shown.enter_context(MetricsFile(metrics, dataset_name(out))))
        summary = run_build(request, Displays(*displays))
    _conclude(summary, out)


def _conclude(summary: "Summary", out: Path) -> None:
    from workers.build import PARTING_WORDS
    from workers.survey import survey

    tally = summary.tally
    if summary.signal:
        print(f"{tally.accounted} of {tally.total} scenes are accounted for; {PARTING_WORDS}")
        raise typer.Exit(128 + summary.signal)
    found = survey(out)
    if tally.before == tally.total:
        print("nothing was left to do")
    print(f"{found.done} done, {found.dropped} dropped, {found.failed} failed of {found.total} scenes, in {out}")
    if found.failed:
        print(f"see why: tableverse failures {out}")
        raise typer.Exit(SOME_FAILED)
