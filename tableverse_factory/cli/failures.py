"""`tableverse failures`: why scenes were lost, where and how often, and how to try them again."""

from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.completions import complete_stages
from tableverse_factory.cli.options import AsJson, BuiltOut

if TYPE_CHECKING:
    from workers.progress.build_state import SceneOutcome


def failures(
    out: BuiltOut,
    stage: Annotated[
        str | None,
        typer.Option(metavar="STAGE", autocompletion=complete_stages, help="Only scenes lost at this stage, also dropped ones."),
    ] = None,
    reason: Annotated[
        str | None,
        typer.Option(metavar="CODE", help="Only scenes lost for this reason or error kind, also dropped ones."),
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Put them back: the next build tries them again.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show why scenes were lost; `--retry` puts them back.

    Without --stage or --reason, the failed ones; with, also those dropped there or for this. What is shown is what
    `--retry` puts back. The next `tableverse build` computes them again and nothing else, and writes their shards anew.

    Example: `tableverse failures out --reason timeout --retry`
    """
    import json
    from dataclasses import asdict

    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.core.text import pluralize
    from workers.plan.invalidate import reopen_scenes
    from workers.progress.build_state import read_build_state

    place = parse_path(out)
    found = read_build_state(place)
    endings = [ending for ending in found.endings if ending.status != "done"]
    chosen = [ending for ending in endings if _is_chosen(ending, stage, reason)]
    if not chosen:
        _check_filters(endings, [cost.stage for cost in found.costs], stage, reason)
    if as_json:
        print(json.dumps([asdict(ending) for ending in chosen], indent=2))
    else:
        _print_outcomes(chosen, "none" if stage or reason else _format_none_failed(endings, out))
    if retry and chosen:
        shards = reopen_scenes(place, [ending.scene_id for ending in chosen])
        where = f"{pluralize(len(chosen), 'scene')} in {pluralize(shards, 'shard')}"
        typer.echo(f"{where} put back: run the same `tableverse build` to try again", err=as_json)


def _check_filters(endings: list["SceneOutcome"], ran: list[str], stage: str | None, reason: str | None) -> None:
    """Refuses what is likely misspelt: a stage that there is not, or a reason where scenes were lost for others.

    Raises:
        InputError: with those that there are.
    """
    from schemas.config import Config
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.core.text import sanitize_line

    usual = [name for name in Config.model_fields if name != "run"]
    stages, reasons = {*usual, *ran, *(ending.stage for ending in endings)}, {ending.why for ending in endings}
    if stage is not None and stage not in stages:
        there = ", ".join(ran or usual)
        raise InputError(f"--stage {sanitize_line(stage, 60)!r}: no such stage; there are {there}")
    if reason is not None and reasons and reason not in reasons:
        there = ", ".join(sanitize_line(name, 60) for name in sorted(reasons)[:10])
        raise InputError(f"--reason {sanitize_line(reason, 60)!r}: nothing was lost for that, but for {there}")


def _is_chosen(ending: "SceneOutcome", stage: str | None, reason: str | None) -> bool:
    if stage is None and reason is None:
        return ending.status == "failed"
    return stage in (None, ending.stage) and reason in (None, ending.why)


def _format_none_failed(endings: list["SceneOutcome"], out: str) -> str:
    if not (dropped := sum(ending.status == "dropped" for ending in endings)):
        return "none"
    return f"none failed; {dropped} {'was' if dropped == 1 else 'were'} dropped: tableverse status {out}"


def _print_outcomes(chosen: list["SceneOutcome"], nothing: str) -> None:
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.core.text import sanitize_line
    from tableverse_factory.viz.gallery.words import explained_all

    if not chosen:
        print(nothing)
        return
    groups: dict[tuple[str, str, str], list["SceneOutcome"]] = {}
    for ending in chosen:
        groups.setdefault((ending.status, ending.stage, ending.why), []).append(ending)
    table = Table("status", "stage", "why", box=None, pad_edge=False)
    table.add_column("scenes", justify="right")
    table.add_column("for example", overflow="fold")
    for (status, stage, why), endings in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
        example = f"{endings[0].scene_id}: {sanitize_line(endings[0].detail)}"
        table.add_row(status, stage, sanitize_line(why, 80), str(len(endings)), example)
    Console(markup=False).print(table)
    for line in explained_all(why for _, _, why in groups):
        print(line)
