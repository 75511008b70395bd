"""`tableverse textures`: table textures from a repository of PBR maps or from a seed."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.completions import complete_textures
from tableverse_factory.cli.options import AsJson, require_local_path
from tableverse_factory.cli.tables import print_json
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

textures = typer.Typer(no_args_is_help=True, help="Make table textures, or index a repository of PBR maps.")

_SHOWN_REJECTIONS = 20


@textures.command("index")
def index(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Unpacked repository, searched recursively without links.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="FILE", callback=require_local_path, help="The Parquet file to write."),
    ],
    source: Annotated[
        str, typer.Option(help="Source if there is no source.json: ambientcg, sharetextures, cc0-textures.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """List sets of PBR maps with category, source and licence, unusable ones with their reason.

    Example: `tableverse textures index ambientcg/ --out textures.parquet`
    """
    from tableverse_factory.sources.textures.library import write_index
    from tableverse_factory.sources.textures.repository import index_textures

    table = index_textures(folder, sanitize_line(source, 100))
    if not table.num_rows:
        raise InputError(f"{sanitize_line(str(folder))}: no map found; they are named as Wood001_1K-JPG_Color.jpg")
    write_index(out, table)
    usable = table["rejected"].null_count
    kinds = Counter(
        f"rejected: {row['rejected']}" if row["rejected"] else f"licence {row['licence'] or 'not stated'}"
        for row in table.select(["rejected", "licence"]).to_pylist()
    )
    counts = dict(sorted(kinds.items(), key=lambda item: (-item[1], item[0])))
    if as_json:
        print_json({"usable": usable, "counts": counts}, indent=None)
        return
    for what, count in counts.items():
        print(f"{count:6d}  {what}")
    rejected = [row for row in table.select(["name", "rejected_detail"]).to_pylist() if row["rejected_detail"]]
    for row in rejected[:_SHOWN_REJECTIONS]:
        print(f"{sanitize_line(row['name'])}: {row['rejected_detail']}")
    print(f"{table.num_rows} sets, {usable} usable, in {out}")


@textures.command("make")
def make(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", autocompletion=complete_textures, help="A seed, or family and number as marble-12."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", callback=require_local_path, help="The PNG file to write.")
    ],
    size: Annotated[int, typer.Option(metavar="PX", help="Side of the picture.")] = 512,
) -> None:
    """Make a procedural table texture, which tiles without seams.

    Example: `tableverse textures make terrazzo-4 --out terrazzo.png --size 1024`
    """
    from tableverse_factory.core.png import encode_png
    from tableverse_factory.core.storage.files import write_atomic
    from tableverse_factory.sources.textures.catalogue import make_texture, name_texture, parse_texture_seed

    seed = parse_texture_seed(name)
    write_atomic(out, encode_png(make_texture(seed, size)))
    print(f"{name_texture(seed)}, {size} x {size} px, in {out}")
