"""`tableverse manifest`: folders of pictures become a table."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile, Overrides, on_this_machine

if TYPE_CHECKING:
    from schemas.config import ObserveConfig
    from tableverse_factory.core.storage.files import StoragePath
    from tableverse_factory.sources.manifest import Manifest
    from tableverse_factory.sources.urls.fetch import FetchBounds
    from tableverse_factory.sources.urls.fetch_lists import Gathered
    from tableverse_factory.sources.urls.image_filter import Sift

_SHOWN_REJECTIONS = 20
_FETCHING = "Fetching, with a list of addresses"
_SIFTING = "Sifting bare pictures"


def manifest(
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="PATHS", help="Folders, files or fsspec URIs; folders are searched through. Lists: see below."
        ),
    ],
    out: Annotated[
        str, typer.Option("--out", "-o", metavar="FILE", help="The Parquet file to write, also s3://bucket/key.")
    ],
    pictures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            callback=on_this_machine,
            help="Where fetched pictures go and are found again; FILE without its ending, and -pictures.",
            rich_help_panel=_FETCHING,
        ),
    ] = None,
    allow_private: Annotated[
        bool, typer.Option("--allow-private", help="Fetch from this network too.", rich_help_panel=_FETCHING)
    ] = False,
    max_mb: Annotated[
        float | None, typer.Option(min=0.001, metavar="MB", help="Of one picture; 32.", rich_help_panel=_FETCHING)
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(min=0.1, metavar="S", help="For one picture, in all; 60.", rich_help_panel=_FETCHING)
    ] = None,
    parallel: Annotated[
        int | None, typer.Option(min=1, max=256, help="At a time; 16.", rich_help_panel=_FETCHING)
    ] = None,
    per_host: Annotated[
        int | None, typer.Option(min=1, max=32, help="At a time from one host; 2.", rich_help_panel=_FETCHING)
    ] = None,
    sift: Annotated[
        bool | None,
        typer.Option(
            "--sift/--no-sift",
            help="Whether small, blurred, odd or repeated pictures are rejected; with a list or a key below they are.",
            rich_help_panel=_SIFTING,
        ),
    ] = None,
    min_side: Annotated[
        int | None, typer.Option(min=0, metavar="PX", help="Shorter side; 256.", rich_help_panel=_SIFTING)
    ] = None,
    max_aspect: Annotated[
        float | None, typer.Option(min=1.0, metavar="RATIO", help="Of the sides; 3.", rich_help_panel=_SIFTING)
    ] = None,
    min_contrast: Annotated[
        float | None,
        typer.Option(min=0.0, metavar="LEVELS", help="Deviation of grey, of 255; 8.", rich_help_panel=_SIFTING),
    ] = None,
    min_sharpness: Annotated[
        float | None, typer.Option(min=0.0, metavar="X", help="See docs/sourcing.md; 0.01.", rich_help_panel=_SIFTING)
    ] = None,
    near_bits: Annotated[
        int | None,
        typer.Option(
            min=-1, max=7, metavar="N", help="Of 64, for repeated pictures; 6, -1 for none.", rich_help_panel=_SIFTING
        ),
    ] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """List captures, layouts and pictures, and check each.

    Each is decoded once. What cannot be used is a row too, with the reason in its column `rejected`. Of the
    configuration, the bounds of its section `observe` count. Files that end in .csv, .jsonl or .parquet are lists of
    addresses, with the columns url, source and licence: their pictures are fetched, and the same command goes on after
    a kill.

    Example: `tableverse manifest photos/ captures/ --out images.parquet`
    """
    import json

    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.core.text import pluralize
    from tableverse_factory.sources.manifest import write_manifest
    from tableverse_factory.sources.urls.lists import is_list

    place, bounds = parse_path(out), load_config(config, overrides or []).observe
    lists = [path for path in paths if is_list(path)]
    thresholds = {"min_side_px": min_side, "max_aspect": max_aspect, "min_contrast": min_contrast}
    thresholds |= {"min_sharpness": min_sharpness, "near_bits": near_bits}
    wanted = _wanted(sift, bool(lists), {name: value for name, value in thresholds.items() if value is not None})
    asked = {"timeout_s": timeout, "parallel": parallel, "per_host": per_host, "allow_private": allow_private or None}
    fetching = _fetching(lists, pictures, max_mb, {name: value for name, value in asked.items() if value is not None})
    gathered = _gathered(lists, _folder(lists, pictures, place), fetching, bounds)
    made = _made(paths, gathered, bounds, wanted)
    write_manifest(place, made.rows)
    if as_json:
        fetched = {"fetched": {"now": gathered.fetched, "earlier": gathered.earlier}} if lists else {}
        print(json.dumps({"counts": _counts(made), "ignored": made.ignored, **fetched}))
        return
    _show(made, out)
    if lists:
        print(f"fetched {pluralize(gathered.fetched, 'picture')}; {gathered.earlier} were there already")


def _wanted(asked: bool | None, from_lists: bool, thresholds: dict[str, Any]) -> "Sift | None":
    """What bare pictures must have: with a list, with a threshold or where it is asked for, unless it is refused."""
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.sources.urls.image_filter import Sift

    if asked is False and thresholds:
        raise InputError("--no-sift takes every picture that decodes: leave out the options about sifting")
    return Sift(**thresholds) if asked or (asked is None and (from_lists or thresholds)) else None


def _fetching(lists: list[str], folder: Path | None, max_mb: float | None, asked: dict[str, Any]) -> "FetchBounds":
    """What fetching may cost; options that say so without a list are refused."""
    import math

    from tableverse_factory.core.errors import InputError
    from tableverse_factory.sources.urls.fetch import FetchBounds

    if not lists and (asked or folder is not None or max_mb is not None):
        raise InputError("options about fetching are for lists of addresses (.csv, .jsonl, .parquet): there is none")
    if not all(math.isfinite(value) for value in (*asked.values(), max_mb or 0.0)):
        raise InputError("--max-mb and --timeout are numbers, not inf or nan")
    return FetchBounds(**asked) if max_mb is None else FetchBounds(max_bytes=int(max_mb * 1e6), **asked)


def _folder(lists: list[str], given: Path | None, out: "StoragePath") -> Path:
    """Where fetched pictures go; beside the manifest, if nothing is said."""
    from tableverse_factory.core.errors import InputError

    if given is not None:
        return given
    if not isinstance(out, Path):
        if lists:
            raise InputError("--pictures is missing: say in which folder of this machine fetched pictures are kept")
        return Path()
    return out.with_name(f"{out.stem}-pictures")


def _gathered(lists: list[str], folder: Path, fetching: "FetchBounds", bounds: "ObserveConfig") -> "Gathered":
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.sources.urls.fetch_lists import NOTHING, gather

    if not lists:
        return NOTHING
    with counter("addresses") as count:
        return gather(lists, folder, fetching, bounds, count.at)


def _made(paths: list[str], gathered: "Gathered", bounds: "ObserveConfig", wanted: "Sift | None") -> "Manifest":
    from tableverse_factory.cli.progress_bar import counter
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.core.text import sanitize_line
    from tableverse_factory.sources.manifest import make_manifest
    from tableverse_factory.sources.urls.lists import is_list

    with counter("entries checked") as count:
        made = make_manifest([path for path in paths if not is_list(path)], bounds, gathered, wanted, count.at)
    if not made.rows:
        raise InputError(
            f"nothing found in {', '.join(sanitize_line(path) for path in paths)[:500]}: a capture is a folder with "
            "color.png, depth.png and camera.json; layouts are JSON files; pictures are JPEG, PNG or WebP"
        )
    return made


def _counts(made: "Manifest") -> dict[str, dict[str, int]]:
    """How many rows of each kind are accepted (an empty reason) or rejected, by reason."""
    counts: dict[str, dict[str, int]] = {}
    for row in made.rows:
        of_kind = counts.setdefault(row.kind.value, {})
        of_kind[row.rejected or "accepted"] = of_kind.get(row.rejected or "accepted", 0) + 1
    return counts


def _show(made: "Manifest", out: str) -> None:
    from rich.console import Console
    from rich.table import Table

    from tableverse_factory.core.text import pluralize, sanitize_line

    table = Table("kind", "what", "rows", box=None, pad_edge=False)
    for kind, reasons in sorted(_counts(made).items()):
        for reason, count in sorted(reasons.items(), key=lambda item: (item[0] != "accepted", item)):
            table.add_row(kind, reason, str(count))
    Console().print(table)
    rejected = [row for row in made.rows if row.rejected]
    for row in rejected[:_SHOWN_REJECTIONS]:
        print(f"{row.kind.value} {sanitize_line(row.url or row.uri)}: {row.rejected}: {row.rejected_detail}")
    if len(rejected) > _SHOWN_REJECTIONS:
        print(f"… and {len(rejected) - _SHOWN_REJECTIONS} more: see the columns rejected and rejected_detail")
    if made.ignored:
        print("left alone: " + ", ".join(f"{count} × {what}" for what, count in made.ignored.items()))
    print(f"{pluralize(len(made.rows), 'row')} in {out}")
    if unlicensed := sum(not row.licence for row in made.rows if not row.rejected):
        print(f"without a licence: {unlicensed}; if these are to be passed on, say it in source.json or in the list")
