"""Extraction of one scene as files in a folder, in any format."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from schemas.identity import UNNAMED, clean_label
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.scene_meta import read_object_names
from tableverse_factory.delivery.formats.folders import SCENE_GLB, SCENE_XML, check_body_name
from tableverse_factory.delivery.formats.glb import encode_glb
from tableverse_factory.delivery.formats.model_contents import ModelContents, read_model_contents
from tableverse_factory.delivery.formats.urdf import encode_urdf
from tableverse_factory.delivery.formats.usd import encode_usd


def extract_scene(scene: Scene, dest: Path, file_format: str = "mjcf") -> tuple[Path, ...]:
    """Write the scene to a new or empty folder, in a format of `FORMATS`, and return the paths."""
    check_format(file_format)
    if dest.exists() and (not dest.is_dir() or any(dest.iterdir())):
        raise InputError(f"{dest}: already there; give a new or an empty folder")
    contents = read_model_contents(scene.model(), colliders=file_format in WITH_COLLIDERS)
    for content in (*contents.objects, *contents.still):
        check_body_name(content.name)
    files = FORMATS[file_format](scene, contents, read_labels(scene.meta))
    for name, data in files.items():
        path = dest / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return tuple(dest / name for name in files)


def check_format(file_format: str) -> None:
    """Refuse an unknown format, and one whose package is not installed."""
    if file_format not in FORMATS:
        raise InputError(f"format {file_format!r:.40}: give one of {', '.join(FORMATS)}")
    if file_format == "usd":
        import_extra("pxr", "USD", "usd")


def read_labels(meta: Mapping[str, Any]) -> dict[str, str]:
    """Read labels of the objects by id from a `meta.json`: the detector's, the judge's name without one, or the id."""
    names = read_object_names(meta)
    labels = {str(entry["object_id"]): clean_label(str(entry.get("label") or "")) for entry in meta.get("objects", ())}
    called = {key: key if name in ("", UNNAMED) else clean_label(name) for key, name in names.items()}
    return {key: called[key] if label == UNNAMED else label for key, label in labels.items()}


FORMATS: dict[str, Callable[[Scene, ModelContents, Mapping[str, str]], dict[str, bytes]]] = {
    "mjcf": lambda scene, contents, labels: {**scene.files(), SCENE_GLB: encode_glb(contents, labels)},
    "glb": lambda _, contents, labels: {SCENE_GLB: encode_glb(contents, labels)},
    "urdf": lambda _, contents, labels: encode_urdf(contents, labels),
    "usd": lambda _, contents, labels: encode_usd(contents, labels),
}
WITH_COLLIDERS = frozenset({"urdf", "usd"})  # the others draw, and need no hulls
MAIN_FILES = {"mjcf": SCENE_XML, "glb": SCENE_GLB, "urdf": "scene.urdf", "usd": "scene.usd"}
"""The file of each format that refers to all others."""
