"""Load an exported scene from files in memory."""

from collections.abc import Mapping

import mujoco

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.physics.mjcf.file_check import check_references
from tableverse_factory.physics.mjcf.validate_model import check_finite, raise_on_nan


def load_model(files: Mapping[str, bytes]) -> mujoco.MjModel:
    """Load the model of a scene's files: `scene.xml` and those in `assets/`.

    Raises:
        InputError: `bad_mjcf` if it is not here, names others, does not load, or holds numbers that are not finite.
    """
    assets = _select_assets(files)
    try:
        with raise_on_nan():
            model = mujoco.MjModel.from_xml_string(files["scene.xml"].decode(), assets)
    except (ValueError, UnicodeDecodeError) as error:
        raise _make_load_error(error) from error
    check_finite(model)
    return model


def load_spec(files: Mapping[str, bytes]) -> mujoco.MjSpec:
    """Load a scene's files as a specification, to edit, attach and compile, which may raise further errors."""
    assets = _select_assets(files)
    try:
        return mujoco.MjSpec.from_string(files["scene.xml"].decode(), assets=assets)
    except (ValueError, UnicodeDecodeError) as error:
        raise _make_load_error(error) from error


def _select_assets(files: Mapping[str, bytes]) -> dict[str, bytes]:
    if "scene.xml" not in files:
        raise InputError("there is no scene.xml", "bad_mjcf")
    check_references(files["scene.xml"], files.keys())
    return {name: data for name, data in files.items() if name.startswith("assets/")}


def _make_load_error(error: Exception) -> InputError:
    return InputError(f"scene.xml does not load: {sanitize_line(str(error), 500)}", "bad_mjcf")
