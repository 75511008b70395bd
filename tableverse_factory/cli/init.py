"""`tableverse init`: a folder with a configuration and a place for captures."""

from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.options import require_local_path

_CAPTURES_TEXT = """\
# Your captures

They belong in `captures/`. A bare photograph is a file there, PNG or JPEG. A capture with depth is a folder of its own
with three files, and a fourth for those who pass scenes on:

| file | what it holds |
|---|---|
| `color.png` | the picture of the table-top |
| `depth.png` | 16 bit, as many pixels as the picture; 0 where nothing was measured |
| `source.json` | `{"source": "where it is from", "licence": "CC-BY-4.0"}`; without it no scene of it may be passed on |
| `camera.json` | `{"fx": …, "fy": …, "cx": …, "cy": …, "width": …, "height": …, "depth_scale": 0.001}` |

`fx`, `fy`, `cx` and `cy` are in pixels; a pixel of `depth.png` times `depth_scale` is its depth in metres. Beside them
may lie `detections.json` and `masks.png`, if something else has found the objects already.

None at hand? `tableverse synth captures` makes some.
"""
_NEXT_STEPS = """\
{folder}/config.yaml          every key, with its meaning, default and bounds
{folder}/CAPTURES.md          what a capture is
{folder}/captures/            where yours belong

Next, in {folder}:
  tableverse synth captures        or put your own captures there
  tableverse manifest captures --out images.parquet
  tableverse build images.parquet out --config config.yaml
  tableverse view out              opens in a browser; Ctrl-C ends it
"""


def init(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", callback=require_local_path, help="Folder to write; made if it does not exist."
        ),
    ] = Path(),
) -> None:
    """Write a commented configuration and a folder for captures.

    Existing files are never replaced: they are an error, and nothing is written.

    Example: `tableverse init kitchen && cd kitchen`
    """
    from tableverse_factory.core.config import format_commented_yaml
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.core.storage.files import write_atomic

    files = {folder / "config.yaml": format_commented_yaml(), folder / "CAPTURES.md": _CAPTURES_TEXT}
    for path in files:
        if path.exists():
            raise InputError(f"{path} is there already and stays as it is: give another FOLDER, or move it away")
    (folder / "captures").mkdir(parents=True, exist_ok=True)
    for path, text in files.items():
        write_atomic(path, text.encode())
    print(_NEXT_STEPS.format(folder=folder), end="")
