"""`tableverse manifest`: image manifest of folders, files and lists of addresses."""

import math
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tableverse_factory.cli.exit_codes import FAILED
from tableverse_factory.cli.options import AsJson, ConfigFile, Overrides, require_local_path
from tableverse_factory.cli.tables import make_table, print_json
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from schemas.config import ObserveConfig
    from tableverse_factory.core.storage.files import StoragePath
    from tableverse_factory.sources.manifest import Manifest
    from tableverse_factory.sources.urls.fetch import FetchBounds
    from tableverse_factory.sources.urls.fetch_lists import FetchedLists
    from tableverse_factory.sources.urls.image_filter import FilterCriteria

_SHOWN_REJECTIONS = 20
_fetching = partial(typer.Option, rich_help_panel="Fetching, with a list of addresses")
_filtering = partial(typer.Option, rich_help_panel="Filter of bare pictures")


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
        _fetching(
            metavar="DIR",
            callback=require_local_path,
            help="Where fetched pictures go and are found again; FILE without its ending, and -pictures.",
        ),
    ] = None,
    allow_private: Annotated[bool, _fetching("--allow-private", help="Fetch from this network too.")] = False,
    max_mb: Annotated[float | None, _fetching(min=0.001, metavar="MB", help="Of one picture; 32.")] = None,
    timeout: Annotated[float | None, _fetching(min=0.1, metavar="S", help="For one picture, in all; 60.")] = None,
    parallel: Annotated[int | None, _fetching(min=1, max=256, help="At a time; 16.")] = None,
    per_host: Annotated[int | None, _fetching(min=1, max=32, help="At a time from one host; 2.")] = None,
    filter_pictures: Annotated[
        bool | None,
        _filtering(
            "--filter/--no-filter",
            help="Whether small, blurred, odd or repeated pictures are rejected; with a list or a key below they are.",
        ),
    ] = None,
    min_side: Annotated[int | None, _filtering(min=0, metavar="PX", help="Shorter side; 256.")] = None,
    max_aspect: Annotated[float | None, _filtering(min=1.0, metavar="RATIO", help="Of the sides; 3.")] = None,
    min_contrast: Annotated[
        float | None, _filtering(min=0.0, metavar="LEVELS", help="Deviation of grey, of 255; 8.")
    ] = None,
    min_sharpness: Annotated[float | None, _filtering(min=0.0, metavar="X", help="See docs/sourcing.md; 0.01.")] = None,
    near_bits: Annotated[
        int | None, _filtering(min=-1, max=7, metavar="N", help="Of 64, for repeated pictures; 6, -1 for none.")
    ] = None,
    known_length: Annotated[
        str | None,
        typer.Option(
            metavar="JSON",
            help="Of bare pictures that have none of their own, see docs/captures.md: a camera's height, say.",
        ),
    ] = None,
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """List captures, layouts and pictures, and check each.

    Each is decoded once. An unusable one is a row too, with the reason in its column `rejected`; where all are, the
    command fails. The bounds come from
    the section `observe` of the configuration. Files that end in .csv, .jsonl or .parquet are lists of addresses, with
    the columns url, source and licence: their pictures are fetched, and the same command resumes after a kill.

    Example: `tableverse manifest photos/ captures/ --out images.parquet`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.config import load_config
    from tableverse_factory.sources.known_length import read_known_length
    from tableverse_factory.sources.manifest import check_manifest_path, create_manifest
    from tableverse_factory.sources.urls.lists import is_list

    place, bounds = check_manifest_path(out), load_config(config, overrides or []).observe
    known = None if known_length is None else read_known_length(known_length, "--known-length")
    lists = [path for path in paths if is_list(path)]
    criteria = {"min_side_px": min_side, "max_aspect": max_aspect, "min_contrast": min_contrast}
    criteria |= {"min_sharpness": min_sharpness, "near_bits": near_bits}
    image_filter = _make_filter(filter_pictures, bool(lists), _drop_none(criteria))
    limits = {"timeout_s": timeout, "parallel": parallel, "per_host": per_host, "allow_private": allow_private or None}
    fetching = _make_fetch_bounds(lists, pictures, max_mb, _drop_none(limits))
    gathered = _fetch_lists(lists, _choose_folder(lists, pictures, place), fetching, bounds)
    with count_progress("entries checked") as count:
        folders = [path for path in paths if not is_list(path)]
        made = create_manifest(folders, out, bounds, gathered, image_filter, count.update, known)
    is_empty = all(row.rejected for row in made.rows)
    if as_json:
        fetched = {"fetched": {"now": gathered.fetched, "earlier": gathered.earlier}} if lists else {}
        print_json({"counts": _count_rows(made), "ignored": made.ignored, **fetched}, indent=None)
    else:
        _print_manifest(made, out)
        if lists:
            print(f"fetched {pluralize(gathered.fetched, 'picture')}; {gathered.earlier} were there already")
    if is_empty:
        print("error: every row is rejected, so there is nothing to build", file=sys.stderr)
        raise typer.Exit(FAILED)


def _drop_none(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _make_filter(wanted: bool | None, from_lists: bool, criteria: dict[str, Any]) -> "FilterCriteria | None":
    """Make the filter of bare pictures: on with a list, a criterion or `--filter`, unless it is refused."""
    from tableverse_factory.sources.urls.image_filter import FilterCriteria

    if wanted is False and criteria:
        raise InputError("--no-filter accepts every picture that decodes: leave out the options of the filter")
    return FilterCriteria(**criteria) if wanted or (wanted is None and (from_lists or criteria)) else None


def _make_fetch_bounds(
    lists: list[str], folder: Path | None, max_mb: float | None, limits: dict[str, Any]
) -> "FetchBounds":
    """Make the bounds of fetching; its options are refused without a list."""
    from tableverse_factory.sources.urls.fetch import FetchBounds

    if not lists and (limits or folder is not None or max_mb is not None):
        raise InputError("options about fetching are for lists of addresses (.csv, .jsonl, .parquet): there is none")
    if not all(math.isfinite(value) for value in (*limits.values(), max_mb or 0.0)):
        raise InputError("--max-mb and --timeout are numbers, not inf or nan")
    return FetchBounds(**limits) if max_mb is None else FetchBounds(max_bytes=int(max_mb * 1e6), **limits)


def _choose_folder(lists: list[str], given: Path | None, out: "StoragePath") -> Path:
    """Choose the folder of fetched pictures; by default beside the manifest."""
    if given is not None:
        return given
    if isinstance(out, Path):
        return out.with_name(f"{out.stem}-pictures")
    if lists:
        raise InputError("--pictures is missing: say in which folder of this machine fetched pictures are kept")
    return Path()


def _fetch_lists(lists: list[str], folder: Path, fetching: "FetchBounds", bounds: "ObserveConfig") -> "FetchedLists":
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.sources.urls.fetch_lists import NO_LISTS, fetch_lists

    if not lists:
        return NO_LISTS
    with count_progress("addresses") as count:
        return fetch_lists(lists, folder, fetching, bounds, count.update)


def _count_rows(made: "Manifest") -> Mapping[str, Mapping[str, int]]:
    """Count the rows of each kind, by reason of rejection or `accepted`."""
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for row in made.rows:
        counts[row.kind.value][row.rejected or "accepted"] += 1
    return counts


def _print_manifest(made: "Manifest", out: str) -> None:
    from rich.console import Console

    table = make_table("kind", "what", "rows")
    for kind, reasons in sorted(_count_rows(made).items()):
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
        print(
            f"without a licence: {unlicensed}; to pass these on, state it in source.json, or in the list of addresses"
        )
