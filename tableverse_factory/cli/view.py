"""`tableverse view`: scenes in the browser."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.arm import check_robot_option
from tableverse_factory.cli.options import Robot
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize

if TYPE_CHECKING:
    from tableverse_factory.viz.viewer.scene_cache import SceneCache

_MAX_SKIPPED = 100  # damaged scenes


def view(
    out: Annotated[
        str,
        typer.Argument(
            metavar="OUT", help="The dataset: OUT of `tableverse build`; or the scene.xml of one exported scene."
        ),
    ],
    scene_id: Annotated[str | None, typer.Argument(help="The scene to show first.", metavar="SCENE")] = None,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 allows every machine that can reach it.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 takes a free one.")] = 8080,
    robot: Robot = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(help="Address of the viewer behind a proxy: https://NAME.github.dev; may repeat."),
    ] = None,
) -> None:
    """View scenes in the browser, and play physics and trajectories.

    Orbit, layouts, collision pieces, contacts, physics, trajectories. Ctrl-C ends it. It needs viser: `pip install
    'tableverse-factory[viewer]'`.

    Example: `tableverse view out` and open the address that it prints
    """
    import signal

    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.viz.viewer.loaded_scene import load_scene_file
    from tableverse_factory.viz.viewer.scene_cache import SceneCache
    from tableverse_factory.viz.viewer.server import Viewer, import_viser

    import_viser()
    single = out.endswith(".xml")
    if single and scene_id is not None:
        raise InputError(f"{out} is one scene: give no SCENE beside it")
    if not single:
        check_robot_option(out, robot, needed=False)
    scenes = SceneCache(load_scene_file(Path(out)) if single else open_dataset(out))
    first = scene_id or _open_first(scenes)
    if first is None:
        raise InputError(f"{out}: no scene is done yet")
    if scene_id is not None and scenes.find_dropped_row(scene_id) is None:
        scenes.open(scene_id)
    ends = {signal.SIGINT, signal.SIGTERM}
    # Blocked before the viewer's threads start, which inherit it: neither signal can come between two lines here.
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)
    try:
        viewer = Viewer(scenes, first, host, port, robot, allow_origin or ())
        print(viewer.url, flush=True)
        signal.sigwait(ends)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ends)  # a second Ctrl-C ends what does not stop
    viewer.stop()


def _open_first(scenes: "SceneCache") -> str | None:
    """Open the first finished scene that is whole; without a finished one, return the first of any status."""
    problem: InputError | None = None
    for skipped, scene_id in enumerate(scenes.search("", "done").scene_ids[:_MAX_SKIPPED]):
        try:
            scenes.open(scene_id)
        except InputError as error:
            problem = problem or error
            continue
        if problem is not None:
            print(f"skipped {pluralize(skipped, 'damaged scene')}: {problem}", file=sys.stderr)
        return scene_id
    if problem is not None:
        raise problem
    return scenes.first()
