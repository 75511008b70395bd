"""`tableverse view`: scenes in the browser."""

from pathlib import Path
from typing import Annotated

import typer

from tableverse_factory.cli.arm import check_robot_option


def view(
    out: Annotated[
        str, typer.Argument(help="The dataset: OUT of `tableverse build`; or the scene.xml of one exported scene.")
    ],
    scene_id: Annotated[str | None, typer.Argument(help="The scene to begin with.", metavar="SCENE")] = None,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 lets everybody in who can reach it.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8080,
    robot: Annotated[
        str | None, typer.Option(help="The arm of trajectories whose robot is a file (*.xml) or menagerie:NAME.")
    ] = None,
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(help="Where browsers see it behind a proxy: https://NAME.github.dev; may be given again."),
    ] = None,
) -> None:
    """Look at scenes in the browser, and play them.

    Orbit, layouts, collision pieces, contacts, physics, trajectories. Ctrl-C ends it. It needs viser: `pip install
    'tableverse-factory[viewer]'`.

    Example: `tableverse view out` and open the address that it prints
    """
    import signal
    import threading

    from tableverse_factory.core.errors import InputError
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.viz.viewer.loaded_scene import load_scene_file
    from tableverse_factory.viz.viewer.scene_cache import SceneCache
    from tableverse_factory.viz.viewer.server import Viewer, import_viser

    import_viser()
    alone = out.endswith(".xml")
    if alone and scene_id is not None:
        raise InputError(f"{out} is one scene: give no other beside it")
    if not alone:
        check_robot_option(out, robot, needed=False)
    shelf = SceneCache(load_scene_file(Path(out)) if alone else open_dataset(out))
    first = scene_id or shelf.first()
    if first is None:
        raise InputError(f"{out}: no scene is committed yet")
    if alone or shelf.find_dropped_row(first) is None:
        shelf.open(first)
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    viewer = Viewer(shelf, first, host, port, robot, allow_origin or ())
    print(viewer.url, flush=True)
    try:
        ended.wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.stop()
