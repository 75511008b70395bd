"""One scene of a dataset as files in a folder, in the format asked for."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from schemas.identity import check_id, clean_label
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.formats.folders import SCENE_GLB
from tableverse_factory.delivery.formats.glb import glb_bytes
from tableverse_factory.delivery.formats.model_contents import ModelContents, contents_of
from tableverse_factory.delivery.formats.urdf import urdf_files
from tableverse_factory.delivery.formats.usd import usd_files


def extract_scene(scene: Scene, dest: Path, file_format: str = "mjcf") -> tuple[Path, ...]:
    """Writes the scene below a new or empty folder and returns the paths.

    Args:
        scene: Of a dataset.
        dest: The folder.
        file_format: A key of `FORMATS`.

    Raises:
        InputError: if the folder is not empty, the format unknown, or the scene does not load.
    """
    if file_format not in FORMATS:
        raise InputError(f"format {file_format!r:.40}: give one of {', '.join(FORMATS)}")
    if dest.exists() and (not dest.is_dir() or any(dest.iterdir())):
        raise InputError(f"{dest}: already there; give a new or an empty folder")
    contents = contents_of(scene.model())
    for content in (*contents.objects, *contents.still):
        _check_name(content.name)
    files = FORMATS[file_format](scene, contents, labels_of(scene.meta))
    for name, data in files.items():
        path = dest / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return tuple(dest / name for name in files)


def labels_of(meta: Mapping[str, Any]) -> dict[str, str]:
    """Labels of the objects by their ids, from a `meta.json`; what has none is called as its id."""
    entries = [(str(entry["object_id"]), entry) for entry in meta.get("objects", ())]
    return {object_id: clean_label(str(entry.get("label", object_id))) for object_id, entry in entries}


def _check_name(name: str) -> None:
    """Names of bodies become names of files: a scene that somebody else wrote may hold anything."""
    try:
        check_id(name)
    except ValueError as error:
        raise InputError(
            f"a body of the scene cannot be a file: {sanitize_line(str(error), 200)}", "bad_name"
        ) from None


def _mjcf(scene: Scene, contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:
    return {**scene.files(), SCENE_GLB: glb_bytes(contents, labels)}


def _glb(scene: Scene, contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:  # noqa: ARG001
    return {SCENE_GLB: glb_bytes(contents, labels)}


def _urdf(scene: Scene, contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:  # noqa: ARG001
    return urdf_files(contents, labels)


def _usd(scene: Scene, contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:  # noqa: ARG001
    return usd_files(contents, labels)


Writer = Callable[[Scene, ModelContents, Mapping[str, str]], dict[str, bytes]]

FORMATS: dict[str, Writer] = {"mjcf": _mjcf, "glb": _glb, "urdf": _urdf, "usd": _usd}
