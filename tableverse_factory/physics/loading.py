"""A scene's files as a model, from memory: the one place where exported MJCF is loaded."""

from collections.abc import Mapping

import mujoco

from tableverse_factory.errors import InputError
from tableverse_factory.physics.mjcf_files import check_references
from tableverse_factory.text import printable


def load_model(files: Mapping[str, bytes]) -> mujoco.MjModel:
    """The model of a scene's files: `scene.xml` and whatever lies in `assets/`.

    Raises:
        InputError: `bad_mjcf` if there is no `scene.xml`, it names a file that is not here, or MuJoCo refuses it.
    """
    if "scene.xml" not in files:
        raise InputError("there is no scene.xml", "bad_mjcf")
    check_references(files["scene.xml"], files.keys())
    assets = {name: data for name, data in files.items() if name.startswith("assets/")}
    try:
        return mujoco.MjModel.from_xml_string(files["scene.xml"].decode(), assets)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"scene.xml does not load: {printable(str(error), 500)}", "bad_mjcf") from error
