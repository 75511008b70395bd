"""Load an exported scene from files in memory."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from contextlib import suppress

import mujoco

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.physics.mjcf.file_check import MAX_DOCUMENT_BYTES, check_references
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


def parse_document(files: Mapping[str, bytes]) -> ET.Element:
    """Parse `scene.xml` of untrusted files; `bad_mjcf` if it is too long, declares entities or is no MJCF."""
    data = files.get("scene.xml")
    if data is None:
        raise InputError("there is no scene.xml", "bad_mjcf")
    if len(data) > MAX_DOCUMENT_BYTES:
        raise InputError("scene.xml: longer than 64 MiB", "bad_mjcf")
    text = _decode_text(data)
    if "<!" in text.replace("<!--", ""):
        raise InputError("scene.xml declares entities, which MJCF never does", "bad_mjcf")
    try:
        root = ET.fromstring(text)  # noqa: S314 - no declarations, so no entities that expand
    except ET.ParseError as error:
        raise InputError(f"scene.xml does not parse: {error}", "bad_mjcf") from None
    if root.tag != "mujoco":
        raise InputError(f"scene.xml is no MJCF: its root is <{root.tag[:40]}>", "bad_mjcf")
    return root


def _decode_text(data: bytes) -> str:
    """Decode UTF-8 only: a parser would detect UTF-16, where a search for `<!` finds none."""
    if b"\0" not in data:
        with suppress(UnicodeDecodeError):
            return data.decode("utf-8-sig")
    raise InputError("scene.xml is not in UTF-8, the one encoding that MuJoCo reads", "bad_mjcf")


def _select_assets(files: Mapping[str, bytes]) -> dict[str, bytes]:
    if "scene.xml" not in files:
        raise InputError("there is no scene.xml", "bad_mjcf")
    check_references(files["scene.xml"], files.keys())
    return {name: data for name, data in files.items() if name.startswith("assets/")}


def _make_load_error(error: Exception) -> InputError:
    return InputError(f"scene.xml does not load: {sanitize_line(str(error), 500)}", "bad_mjcf")
