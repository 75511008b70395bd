"""`tableverse manifest`: folders of pictures become a table."""

from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.options import AsJson, ConfigFile, Overrides

if TYPE_CHECKING:
    from tableverse_factory.manifest import Manifest

_SHOWN_REJECTIONS = 20


def manifest(
    paths: Annotated[
        list[str], typer.Argument(metavar="PATHS", help="Folders, files or fsspec URIs; folders are searched through.")
    ],
    out: Annotated[
        str, typer.Option("--out", "-o", metavar="FILE", help="The Parquet file to write, also s3://bucket/key.")
    ],
    config: ConfigFile = None,
    overrides: Overrides = None,
    as_json: AsJson = False,
) -> None:
    """List captures, layouts and pictures, and check each.

    Each is decoded once. What cannot be used is a row too, with the reason in its column `rejected`. Of the
    configuration, the bounds of its section `observe` count.

    Example: `tableverse manifest photos/ captures/ --out images.parquet`
    """
    import json

    from tableverse_factory.configuration import load_config
    from tableverse_factory.errors import InputError
    from tableverse_factory.manifest import make_manifest, write_manifest
    from tableverse_factory.storage import place_of
    from tableverse_factory.text import printable

    place = place_of(out)
    made = make_manifest(paths, load_config(config, overrides or []).observe)
    if not made.rows:
        raise InputError(
            f"nothing found in {', '.join(printable(path) for path in paths)[:500]}: a capture is a folder with "
            "color.png, depth.png and camera.json; layouts are JSON files; pictures are JPEG, PNG or WebP"
        )
    write_manifest(place, made.rows)
    if as_json:
        print(json.dumps({"counts": _counts(made), "ignored": made.ignored}))
    else:
        _show(made, out)


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

    from tableverse_factory.text import counted, printable

    table = Table("kind", "what", "rows", box=None, pad_edge=False)
    for kind, reasons in sorted(_counts(made).items()):
        for reason, count in sorted(reasons.items(), key=lambda item: (item[0] != "accepted", item)):
            table.add_row(kind, reason, str(count))
    Console().print(table)
    rejected = [row for row in made.rows if row.rejected]
    for row in rejected[:_SHOWN_REJECTIONS]:
        print(f"{row.kind.value} {printable(row.uri)}: {row.rejected}: {row.rejected_detail}")
    if len(rejected) > _SHOWN_REJECTIONS:
        print(f"… and {len(rejected) - _SHOWN_REJECTIONS} more: see the columns rejected and rejected_detail")
    if made.ignored:
        print("left alone: " + ", ".join(f"{count} × {what}" for what, count in made.ignored.items()))
    print(f"{counted(len(made.rows), 'row')} in {out}")
    if unlicensed := sum(not row.licence for row in made.rows if not row.rejected):
        print(f"without a licence: {unlicensed}; if these are to be passed on, put a source.json beside each")
