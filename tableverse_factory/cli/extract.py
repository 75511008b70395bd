"""`tableverse extract`: write one scene as files."""

from typing import Annotated, Literal

import typer

from tableverse_factory.cli.options import NewFolder, ReadableOut, SceneId, Texture


def extract(
    out: ReadableOut,
    scene_id: SceneId,
    dest: NewFolder,
    file_format: Annotated[
        Literal["mjcf", "glb", "urdf", "usd"], typer.Option("--format", help="What to write.")
    ] = "mjcf",
    texture: Texture = None,
    lights: Annotated[int | None, typer.Option(min=0, metavar="SEED", help="Other lights.")] = None,
    camera: Annotated[int | None, typer.Option(min=0, metavar="SEED", help="A slightly moved camera.")] = None,
) -> None:
    """Write one scene as MJCF, GLB, URDF or USD.

    MJCF has a scene.glb beside it, and loads with nothing but MuJoCo; USD has physics.

    --texture, --lights and --camera change only its appearance (docs: Randomisation).

    USD needs usd-core: `pip install 'tableverse-factory[usd]'`.

    Example: `tableverse extract out kitchen-0123456789ab scene/ && python -m mujoco.viewer --mjcf scene/scene.xml`
    """
    from tableverse_factory.core.text import pluralize
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.delivery.formats.extract import extract_scene

    scene = open_dataset(out).scene(scene_id).restyle(texture, lights, camera)
    paths = extract_scene(scene, dest, file_format)
    print(f"{pluralize(len(paths), 'file')} in {dest}")
