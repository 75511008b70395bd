"""`tableverse export`: a dataset to pass on, and its trajectories in formats for training."""

import difflib
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from tableverse_factory.cli.arm import check_robot_option
from tableverse_factory.cli.options import BuiltOut, FinishedOut, Robot, require_local_path
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.core.storage.files import StoragePath


_DEFAULT = "dataset"
_Picture = StrEnum(  # Typer takes no list of literals
    "_Picture",
    """FRONT FRONT_DEPTH FRONT_INSTANCES WRIST WRIST_DEPTH WRIST_INSTANCES
    SCENE SCENE_DEPTH SCENE_INSTANCES""",
)


class _DefaultCommandGroup(TyperGroup):
    """`export OUT DEST` without the name of a command is `export dataset OUT DEST`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command if none is named."""
        if args and args[0] not in (*self.commands, "--help", "-h"):
            near = difflib.get_close_matches(args[0], self.commands, n=1, cutoff=0.75)
            if near and not Path(args[0]).exists():
                ctx.fail(f"No such folder or command {sanitize_line(args[0], 80)!r}. Did you mean {near[0]!r}?")
            args = [_DEFAULT, *args]
        return super().parse_args(ctx, args)


export = typer.Typer(
    cls=_DefaultCommandGroup,
    no_args_is_help=True,
    help="Write a dataset to pass on, or trajectories for learners.\n\n`export OUT DEST` means `export dataset`.",
)

Pictures = Annotated[
    list[_Picture] | None,
    typer.Option(help="May be repeated; LeRobot has front and wrist by default. scene: the photograph's camera."),
]
Failed = Annotated[bool, typer.Option("--failed", help="Failures too; they are marked.")]


@export.command(_DEFAULT)
def export_dataset(
    out: BuiltOut,
    dest: Annotated[
        str,
        typer.Argument(
            metavar="DEST", help="A new or empty folder for the dataset that is passed on, or s3://bucket/prefix."
        ),
    ],
    profile: Annotated[
        Literal["permissive", "share-alike", "non-commercial"],
        typer.Option(help="permissive: credit at most; share-alike and non-commercial allow these terms too."),
    ] = "permissive",
    unfinished: Annotated[bool, typer.Option("--unfinished", help="Write the shards that there are.")] = False,
) -> None:
    """Write the scenes whose licences allow it as a dataset of their own, without any trace of the others.

    Example: `tableverse export dataset out out-public --profile permissive`; the word `dataset` may be left out.
    """
    from tableverse_factory.core.storage.apart import require_apart
    from tableverse_factory.core.storage.files import parse_path
    from tableverse_factory.dataset.journals import WORK
    from tableverse_factory.delivery.license_filter import write_filtered_dataset
    from workers.state.lock import LOCK, create_writer_lock

    place = parse_path(dest)
    require_apart(place, parse_path(out))
    with _remove_if_unused(place), create_writer_lock(place / WORK / LOCK):
        result = write_filtered_dataset(parse_path(out), place, profile, unfinished)
    print(f"{pluralize(result.kept, 'scene')}, {result.done} of them with files, in {dest}")
    for verdict, count in sorted(result.left_out.items()):
        print(f"left out: {count} {verdict.value}")


@contextmanager
def _remove_if_unused(dest: "StoragePath") -> Iterator[None]:
    """Remove the folder if it was made for the lock alone."""
    is_new = isinstance(dest, Path) and not dest.exists()
    try:
        yield
    finally:
        if is_new and isinstance(dest, Path) and dest.is_dir() and not any(dest.iterdir()):
            dest.rmdir()


def _list_pictures(given: list[_Picture] | None) -> tuple[str, ...]:
    return tuple(dict.fromkeys(picture.value for picture in given or ()))


@export.command("pictures")
def export_pictures(
    out: FinishedOut,
    dest: Annotated[
        Path, typer.Argument(metavar="DEST", callback=require_local_path, help="A folder that does not exist yet.")
    ],
) -> None:
    """Write photographs, masks, labels and instructions as a table with image columns, for `datasets.load_dataset`.

    Example: `tableverse export pictures out out-pictures`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.delivery.formats.picture_table import export_pictures as write

    with count_progress("scenes") as count:
        counts = write(open_dataset(out), dest, count.update)
    print(f"{', '.join(f'{split} {rows}' for split, rows in counts.items())}, in {dest}")


@export.command("lerobot")
def export_lerobot(
    out: FinishedOut,
    dest: Annotated[
        Path, typer.Argument(metavar="DEST", callback=require_local_path, help="A folder that does not exist yet.")
    ],
    failed: Failed = False,
    width: Annotated[int, typer.Option(min=16, max=4096, metavar="PX", help="Of the pictures, even.")] = 320,
    height: Annotated[int, typer.Option(min=16, max=4096, metavar="PX", help="Of the pictures, even.")] = 240,
    fps: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Frames per second, a divisor of the recorded ones, which are the default."
        ),
    ] = None,
    picture: Pictures = None,
    jobs: Annotated[int, typer.Option(min=1, metavar="N", help="Processes that draw.")] = 1,
    robot: Robot = None,
) -> None:
    """Write the trajectories as a LeRobot dataset, version 3.0: state, action, task, success, and rendered video.

    Example: `tableverse export lerobot out out-lerobot --fps 10 --jobs 4`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.delivery.episodes.lerobot import LeRobotOptions
    from tableverse_factory.delivery.episodes.lerobot import export_lerobot as write

    check_robot_option(out, robot, needed=True)
    pictures = _list_pictures(picture) or ("front", "wrist")
    options = LeRobotOptions(failed, width, height, fps, pictures, jobs, robot)
    with count_progress("episodes") as count:
        written = write(open_dataset(out), dest, options, count.update)
    seen = ", ".join(written.pictures)
    print(f"{pluralize(written.episodes, 'episode')}, {written.frames} frames of {seen}, in {dest}")


@export.command("robomimic")
def export_robomimic(
    out: FinishedOut,
    dest: Annotated[
        Path,
        typer.Argument(metavar="DEST", callback=require_local_path, help="A new file of any name, e.g. `out.hdf5`."),
    ],
    failed: Failed = False,
    picture: Pictures = None,
    width: Annotated[int, typer.Option(min=16, max=4096, metavar="PX", help="Of the pictures.")] = 128,
    height: Annotated[int, typer.Option(min=16, max=4096, metavar="PX", help="Of the pictures.")] = 96,
    jobs: Annotated[int, typer.Option(min=1, metavar="N", help="Processes.")] = 1,
    robot: Robot = None,
) -> None:
    """Write the trajectories as one HDF5 file of robomimic: states, actions, observations, and the models to replay.

    Example: `tableverse export robomimic out out.hdf5 --failed`
    """
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.delivery.episodes.robomimic import RobomimicOptions
    from tableverse_factory.delivery.episodes.robomimic import export_robomimic as write

    check_robot_option(out, robot, needed=True)
    options = RobomimicOptions(failed, _list_pictures(picture), width, height, jobs, robot)
    written = write(open_dataset(out), dest, options)
    print(f"{pluralize(written.demos, 'demonstration')}, {written.samples} samples, in {dest}")
