"""`tableverse report`: a gallery of a dataset as static HTML."""

import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from tableverse_factory.cli.arm import check_robot_option
from tableverse_factory.cli.options import Jobs, Robot, require_local_path


def report(
    out: Annotated[str, typer.Argument(help="The dataset: OUT of `tableverse build`, finished or not.")],
    dest: Annotated[
        Path | None,
        typer.Option(
            callback=require_local_path,
            help="Folder of the gallery; by default OUT-gallery beside the dataset, or here for s3://….",
        ),
    ] = None,
    jobs: Jobs = None,
    renders: Annotated[
        int | None,
        typer.Option(
            min=0, help="Scenes to draw from every side, the first ones; by default all, or 6 of more than 60."
        ),
    ] = None,
    films: Annotated[
        int | None,
        typer.Option(min=0, help="Most films per drawn scene; by default 6, or none for more than 60 scenes."),
    ] = None,
    robot: Robot = None,
) -> None:
    """Write a gallery of a dataset as static HTML.

    It shows the funnel, statistics, and every scene beside its photograph. Run it again to go on where it was stopped,
    and to add scenes built since: what is drawn stays.

    Example: `tableverse report out && xdg-open out-gallery/index.html`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.viz.destination import choose_destination
    from tableverse_factory.viz.gallery.gallery import write_gallery

    dataset = open_dataset(out)
    check_robot_option(out, robot, needed=False)
    dest, processes = dest or choose_destination(out, "gallery"), jobs or count_available_cpus()
    with _unwind_on_sigterm(), count_progress("scenes") as count:
        index = write_gallery(dataset, dest, processes, count.update, renders=renders, films=films, robot=robot)
    _report_damage(out, dataset.shards)
    print(index)


@contextmanager
def _unwind_on_sigterm() -> Iterator[None]:
    """Let SIGTERM unwind the block as Ctrl-C does, once, so that the index shows what is drawn; it exits with 143."""

    def leave(number: int, _frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # a second one would interrupt that
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _report_damage(out: str, shards: Iterable[int]) -> None:
    """Report damaged shards on stderr, which the gallery states only on the pages of their scenes."""
    from tableverse_factory.core.errors import BuildError
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.integrity import check_tars

    if "://" in out and not out.startswith(("s3://", "file:///")):
        return  # `open_dataset` reads other places too, which builds do not write
    try:
        check_tars(parse_path(out), shards)
    except FileNotFoundError:
        return  # a shard is being rewritten just now
    except BuildError as error:
        print(f"scenes could not be opened: {error}", file=sys.stderr)
