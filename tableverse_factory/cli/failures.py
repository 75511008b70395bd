"""`tableverse failures`: reasons of lost scenes, and how to retry them."""

import shlex
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.completions import complete_stages
from tableverse_factory.cli.exit_codes import TROUBLESHOOTING
from tableverse_factory.cli.options import AsJson, BuiltOut
from tableverse_factory.cli.tables import make_table, print_json
from tableverse_factory.core import errors
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from workers.progress.build_state import LostScene


def failures(
    out: BuiltOut,
    stage: Annotated[
        str | None,
        typer.Option(
            metavar="STAGE", autocompletion=complete_stages, help="Only scenes lost at this stage, also dropped ones."
        ),
    ] = None,
    reason: Annotated[
        str | None,
        typer.Option(metavar="CODE", help="Only scenes lost for this reason or error kind, also dropped ones."),
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Put them back: the next run tries them again.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show why scenes were lost; `--retry` puts them back.

    Without --stage or --reason, the failed ones; with, also those dropped there or for this. What is shown is what
    `--retry` puts back. The command that made the dataset then computes them again and nothing else, and writes their
    shards anew.

    Example: `tableverse failures out --reason timeout --retry`
    """
    from schemas.manifest import SceneKind
    from tableverse_factory.core.storage.files import parse_path
    from workers.plan.invalidate import reopen_scenes
    from workers.progress.build_state import LOST_COLUMNS, read_build_state

    place = parse_path(out)
    state = read_build_state(place, (*LOST_COLUMNS, "kind"), ["stage"])
    lost = state.list_lost()
    if stage is None and reason is None:
        selected = [scene for scene in lost if scene.status == "failed"]
    else:
        selected = [its for its in lost if stage in (None, its.stage) and reason in (None, its.why)]
    if not selected:
        _check_filters(lost, state.timings["stage"].unique().to_pylist(), stage, reason)
    if as_json:
        names = ("scene_id", "status", "stage", "why", "detail", "attempts", "shard")
        print_json([{**{n: getattr(its, n) for n in names}, "help": _find_help(its.why)} for its in selected])
    else:
        _print_scenes(selected, "none" if stage or reason else _format_none_failed(lost, out))
    if retry and selected:
        shards = reopen_scenes(place, [scene.scene_id for scene in selected])
        where = f"{pluralize(len(selected), 'scene')} in {pluralize(shards, 'shard')}"
        made_by = "cousins" if state.scenes["kind"].unique().to_pylist() == [SceneKind.COUSIN] else "build"
        typer.echo(f"{where} put back: run the same `tableverse {made_by}` to try again", err=as_json)


def _find_help(why: str) -> str:
    """Find the entry of the troubleshooting page: a reason is its own anchor, an error class has a topic."""
    return f"{TROUBLESHOOTING}#{getattr(getattr(errors, why, None), 'topic', why)}"


def _check_filters(lost: list["LostScene"], ran: list[str], stage: str | None, reason: str | None) -> None:
    """Refuse a stage that does not exist, or a reason for which no scene was lost."""
    from schemas.config import Config

    usual = [name for name in Config.model_fields if name != "run"]
    stages, reasons = {*usual, *ran, *(scene.stage for scene in lost)}, {scene.why for scene in lost}
    if stage is not None and stage not in stages:
        raise errors.InputError(
            f"--stage {sanitize_line(stage, 60)!r}: no such stage; there are {', '.join(ran or usual)}"
        )
    if reason is not None and reasons and reason not in reasons:
        names = ", ".join(sanitize_line(name, 60) for name in sorted(reasons)[:10])
        raise errors.InputError(f"--reason {sanitize_line(reason, 60)!r}: nothing was lost for that, but for {names}")


def _format_none_failed(lost: list["LostScene"], out: str) -> str:
    if not (dropped := sum(scene.status == "dropped" for scene in lost)):
        return "none"
    return f"none failed\n{format_dropped(dropped, out)}"


def format_dropped(count: int, out: str) -> str:
    """Format how many scenes were dropped, and the command that lists why."""
    which = "--where \"status = 'dropped'\" --columns scene_id,reason,detail"
    return f"why {count} {'was' if count == 1 else 'were'} dropped: tableverse query {shlex.quote(out)} {which}"


def _print_scenes(selected: list["LostScene"], nothing: str) -> None:
    from rich.console import Console

    from tableverse_factory.viz.gallery.formatting import explain_reasons

    if not selected:
        print(nothing)
        return
    groups: dict[tuple[str, str, str], list["LostScene"]] = {}
    for scene in selected:
        groups.setdefault((scene.status, scene.stage, scene.why), []).append(scene)
    table = make_table("status", "stage", "why", figures=["scenes"])
    table.add_column("for example", overflow="fold")
    for (status, stage, why), scenes in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
        example = f"{sanitize_line(scenes[0].scene_id)}: {sanitize_line(scenes[0].detail)}"
        table.add_row(*(sanitize_line(text, 80) for text in (status, stage, why)), str(len(scenes)), example)
    Console(markup=False).print(table)
    for line in explain_reasons(why for _, _, why in groups):
        print(line)
    for why in dict.fromkeys(why for _, _, why in groups):
        print(f"help: {sanitize_line(_find_help(why), 160)}")
