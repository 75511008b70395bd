"""`tableverse extract`: one scene out of its shard."""

from pathlib import Path
from typing import Annotated

import typer


def extract(
    out: Annotated[str, typer.Argument(help="The dataset: OUT of `tableverse build`.")],
    scene_id: Annotated[str, typer.Argument(help="Which scene; `tableverse query OUT --table scenes` lists them.")],
    dest: Annotated[Path, typer.Argument(help="A new or empty folder.")],
) -> None:
    """Write one scene's files into a folder.

    Example: `tableverse extract out kitchen-0123456789ab scene/ && python -m mujoco.viewer --mjcf scene/scene.xml`
    """
    from tableverse_factory.dataset import open_dataset

    paths = open_dataset(out).scene(scene_id).extract(dest)
    print(f"{len(paths)} files in {dest}")
