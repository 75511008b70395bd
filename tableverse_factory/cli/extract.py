"""`tableverse extract`: one scene out of its shard."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class FileFormat(StrEnum):
    """What a scene can be written as (`tableverse_factory.formats.extract.FORMATS`)."""

    MJCF = "mjcf"
    GLB = "glb"
    URDF = "urdf"
    USD = "usd"


def extract(
    out: Annotated[str, typer.Argument(help="The dataset: OUT of `tableverse build`.")],
    scene_id: Annotated[str, typer.Argument(help="Which scene; `tableverse query OUT --table scenes` lists them.")],
    dest: Annotated[Path, typer.Argument(help="A new or empty folder.")],
    file_format: Annotated[FileFormat, typer.Option("--format", help="What to write.")] = FileFormat.MJCF,
    texture: Annotated[
        str | None, typer.Option(help="What lies on the table: a seed, or family and number as marble-12.")
    ] = None,
    lights: Annotated[int | None, typer.Option(min=0, help="Seed for other lamps.")] = None,
    camera: Annotated[int | None, typer.Option(min=0, help="Seed for a small step aside of the camera.")] = None,
) -> None:
    """Write one scene as MJCF, GLB, URDF or USD.

    MJCF has a scene.glb beside it, and loads with nothing but MuJoCo; USD has physics.

    --texture, --lights and --camera change its looks alone (docs: Randomisation).

    USD needs usd-core: `pip install 'tableverse-factory[usd]'`.

    Example: `tableverse extract out kitchen-0123456789ab scene/ && python -m mujoco.viewer --mjcf scene/scene.xml`
    """
    from tableverse_factory.dataset import open_dataset
    from tableverse_factory.formats.extract import extract_scene

    scene = open_dataset(out).scene(scene_id).restyled(texture, lights, camera)
    paths = extract_scene(scene, dest, file_format.value)
    print(f"{len(paths)} files in {dest}")
