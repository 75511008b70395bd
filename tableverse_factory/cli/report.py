"""`tableverse report`: a gallery that opens from disk."""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.arm import check_robot_option


def report(
    out: Annotated[str, typer.Argument(help="The dataset: OUT of `tableverse build`, finished or not.")],
    dest: Annotated[
        Path | None,
        typer.Option(help="Folder of the gallery; OUT-gallery, beside the dataset, by default; of s3://… in this one."),
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes that draw; one per CPU by default.")] = None,
    renders: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Draw so many scenes from every side, the first ones; all by default, of more than 60 the first 6.",
        ),
    ] = None,
    films: Annotated[
        int | None,
        typer.Option(min=0, help="At most so many of each drawn scene; 6 by default, none of more than 60 scenes."),
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="The arm of trajectories whose robot is a file (*.xml) or menagerie:NAME.")
    ] = None,
) -> None:
    """Write a gallery as static HTML.

    The funnel, statistics, and every scene beside its photograph.

    Example: `tableverse report out && xdg-open out-gallery/index.html`
    """
    from tableverse_factory.cli.cleanup_on_sigterm import unwind_on_sigterm
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.viz.gallery.gallery import write_gallery
    from tableverse_factory.viz.output_folder import choose_destination

    dataset = open_dataset(out)
    check_robot_option(out, robot, needed=False)
    with unwind_on_sigterm(), count_progress("drawn") as count:
        index = write_gallery(
            dataset,
            dest or choose_destination(out, "gallery"),
            jobs or count_available_cpus(),
            count.update,
            renders=renders,
            films=films,
            robot=robot,
        )
    _say_what_is_damaged(out, dataset.shards)
    print(index)


def _say_what_is_damaged(out: str, shards: Iterable[int]) -> None:
    """Why scenes have no pictures, where it is their shard: the gallery says it on the page of each alone."""
    from tableverse_factory.core.errors import BuildError
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.integrity import check_tars

    if "://" in out and not out.startswith(("s3://", "file:///")):
        return  # `open_dataset` reads more kinds of places than builds write
    try:
        check_tars(parse_path(out), shards)
    except FileNotFoundError:
        return  # a shard is being written again just now, so its lengths say nothing
    except BuildError as error:
        print(f"scenes could not be opened: {error}", file=sys.stderr)
