"""`tableverse extract`: write scenes as files."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from tableverse_factory.cli.completions import complete_scene_ids
from tableverse_factory.cli.options import Jobs, ReadableOut, Texture, require_local_path
from tableverse_factory.core.text import pluralize

SHOWN_REFUSALS = 10


def extract(
    out: ReadableOut,
    dest: Annotated[
        Path,
        typer.Argument(
            metavar="DEST", help="A new or empty folder, or one to go on with.", callback=require_local_path
        ),
    ],
    scene_id: Annotated[
        str,
        typer.Option(
            "--scene", metavar="SCENE_ID", help="Only this one, into DEST itself.", autocompletion=complete_scene_ids
        ),
    ] = "",
    where: Annotated[
        str | None, typer.Option("--where", "-w", metavar="CONDITION", help="Over scenes/, as of `tableverse query`.")
    ] = None,
    file_format: Annotated[
        Literal["mjcf", "glb", "urdf", "usd"], typer.Option("--format", help="What to write.")
    ] = "mjcf",
    texture: Texture = None,
    lights: Annotated[int | None, typer.Option(min=0, metavar="SEED", help="Other lights.")] = None,
    camera: Annotated[int | None, typer.Option(min=0, metavar="SEED", help="A slightly moved camera.")] = None,
    jobs: Jobs = None,
) -> None:
    """Write scenes as MJCF, GLB, URDF or USD, a folder each.

    DEST/index.jsonl has a line for each: path, split by picture, licence, tasks. The same command again goes on.

    MJCF has a scene.glb beside it, and loads with nothing but MuJoCo; USD has physics.

    --texture, --lights and --camera change only the appearance (docs: Randomisation).

    USD needs usd-core: `pip install 'tableverse-factory[usd]'`.

    Example: `tableverse extract out scenes --where "usable = true and n_objects >= 4"`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.delivery.formats.extract import extract_scene
    from tableverse_factory.delivery.formats.extract_scenes import Appearance, extract_scenes

    if scene_id:
        if where is not None:
            raise typer.BadParameter("--scene is one scene and --where many: give one of them")
        scene = open_dataset(out).scene(scene_id).restyle(texture, lights, camera)
        print(f"{pluralize(len(extract_scene(scene, dest, file_format)), 'file')} in {dest}")
        return
    look = Appearance(texture, lights, camera)
    with count_progress("scenes") as progress:
        summary = extract_scenes(out, dest, file_format, where, look, jobs or count_available_cpus(), progress.update)
    there = f", {summary.kept} were there" if summary.kept else ""
    print(f"{pluralize(summary.written, 'scene')} written to {dest}{there}")
    for name, why in summary.refused[:SHOWN_REFUSALS]:
        print(f"  not {name}: {why}")
    if summary.refused:
        print(f"{pluralize(len(summary.refused), 'scene')} could not be written")
        raise typer.Exit(1)
