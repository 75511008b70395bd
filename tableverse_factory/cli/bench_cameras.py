"""`tableverse bench cameras`: how fast the pictures of policies are drawn."""

import re
from typing import Annotated

import typer

from tableverse_factory.cli.options import AsJson
from tableverse_factory.cli.tables import print_figures, print_json
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

_MAX_PX = 4096


def bench_cameras(
    dataset: Annotated[str, typer.Argument(metavar="OUT", help="A dataset with trajectories.")],
    size: Annotated[
        list[str] | None, typer.Option(metavar="WxH", help="128x96 and 256x256 by default. May be repeated.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Trajectories, spread evenly over all.")] = 8,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each, after the first.")] = 30,
    as_json: AsJson = False,
) -> None:
    """Measure how many frames a second of one core draws, as exports and environments show them to policies.

    Example: `tableverse bench cameras out --size 128x96`
    """
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.evaluation.bench.cameras import bench_cameras as measure

    costs = measure(
        open_dataset(dataset), [_parse_size(text) for text in size or ("128x96", "256x256")], episodes, frames
    )
    if as_json:
        print_json(costs)
        return
    rows = ([f"{c.pictures}, {c.width} × {c.height}", f"{c.frames_per_s:.1f}", f"{c.first_s:.2f}"] for c in costs)
    print_figures(["pictures", "frames per CPU s", "CPU s of the first"], rows)
    print(f"medians of {costs[0].episodes} trajectories")


def _parse_size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    size = (int(found[1]), int(found[2])) if found else (0, 0)
    if not all(1 <= side <= _MAX_PX for side in size):
        raise InputError(f"--size {sanitize_line(text, 40)}: give width and height, e.g. 128x96", "bad_size")
    return size
