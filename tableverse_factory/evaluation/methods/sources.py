"""Discovery of methods and their scenes: datasets, layout files, GLB files, MJCF files, and folders of them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.compute as pc

from schemas.config import ObserveConfig
from schemas.geometry import ConvexPieces, Pose
from schemas.layout import LayoutPose
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_finite, parse_json, read_bytes
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.delivery.formats.folders import find_scene_file, list_scene_folders
from tableverse_factory.delivery.formats.model_contents import ModelObject, VisualMesh, is_table, read_model_contents
from tableverse_factory.evaluation.methods.glb import GREY, read_glb_scene
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene, SceneSource
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes
from tableverse_factory.physics.mjcf.file_check import load_mjcf
from tableverse_factory.sources.discovery import is_source_file
from tableverse_factory.sources.layout_file import read_layout_file, read_layout_meshes

MAX_METHODS = 12
WORLD = "world"  # name of the world body in MuJoCo


def parse_methods(paths: Sequence[Path], named: Sequence[str]) -> dict[str, Path]:
    """Parse methods by name: paths first, named after their last part, then `NAME=PATH`; raise `bad_method`."""
    methods: dict[str, Path] = {}
    entries = [(path.resolve().stem, path) for path in paths]
    for text in named:
        name, equals, path_text = text.partition("=")
        if not (name.strip() and equals and path_text):
            raise InputError(f"method {text!r:.100}: give NAME=PATH", "bad_method")
        entries.append((name.strip(), Path(path_text)))
    for name, path in entries:
        if name in methods:
            raise InputError(f"two methods are called {name!r:.100}: name them with --method NAME=PATH", "bad_method")
        methods[name] = path
    if not 1 <= len(methods) <= MAX_METHODS:
        raise InputError(
            f"{len(methods)} methods: give 1 to {MAX_METHODS}, as PATH or --method NAME=PATH", "bad_method"
        )
    return methods


def find_scenes(path: Path) -> list[SceneSource]:
    """Find the scenes at a path, sorted by name; raise `no_scenes` if there is none.

    A file is a layout (.json), a GLB or an MJCF scene (.xml). A folder is one of our datasets; or a scene as released
    by the authors of TableVerse (XML, assets and scene.glb, of which the XML is read); or a folder of such files or
    folders. Layouts have priority: other files beside them are taken for their meshes.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder", "no_scenes")
    sources = _find_in_file(path, path.parent) if path.is_file() else _find_in_folder(path)
    if not sources:
        raise InputError(
            f"{path}: no scenes; give a dataset, or layouts (*.json), GLB or MJCF scenes, or a folder of scene folders",
            "no_scenes",
        )
    return sorted(sources, key=lambda source: source.name)


def _find_in_file(path: Path, root: Path) -> list[SceneSource]:
    """Make the source of one scene, named after its file; files that an MJCF names must be below `root`."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: give a file that ends in {', '.join(_READERS)}", "no_scenes")
    kind, read = reader
    return [SceneSource(path.stem, kind, partial(read_mjcf, path, root) if read is read_mjcf else partial(read, path))]


def _find_in_folder(folder: Path) -> list[SceneSource]:
    if (folder / "run.json").is_file():
        return find_exported(folder, _read_exported)
    if (scene := find_scene_file(folder)) is not None:
        return [_make_named_source(scene, folder.name, folder)]
    entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    layouts = [entry for entry in entries if entry.suffix.lower() == ".json" and not is_source_file(entry.name)]
    if any(_looks_like_layout(entry) for entry in layouts):
        return [source for entry in layouts for source in _find_in_file(entry, folder)]
    files = [entry for entry in entries if entry.is_file() and entry.suffix.lower() in (".glb", ".xml")]
    return [
        *(source for entry in files for source in _find_in_file(entry, folder)),
        *(_make_named_source(file, name, folder) for name, file in list_scene_folders(folder)),
    ]


def _make_named_source(scene: Path, name: str, root: Path) -> SceneSource:
    return replace(_find_in_file(scene, root)[0], name=name)


def _looks_like_layout(path: Path) -> bool:
    try:
        value = parse_json(read_bytes(str(path), MAX_JSON_BYTES, "bad_layout"), path.name, "bad_layout")
    except InputError:
        return False
    return isinstance(value, dict) and isinstance(value.get("objects"), list)


def find_exported(folder: Path, read: Callable[[Dataset, str], MethodScene]) -> list[SceneSource]:
    """Find the finished scenes of a dataset, sorted by id; `read` takes the dataset and the id."""
    dataset = open_dataset(folder)
    done = dataset.scenes.to_table(filter=pc.field("status") == "done", columns=["scene_id"]).column(0).to_pylist()
    return [SceneSource(scene_id, "dataset", partial(read, dataset, scene_id)) for scene_id in sorted(done)]


def count_dropped_scenes(path: Path) -> int | None:
    """Count the dropped and failed scenes of a dataset; None if the path is not one of our datasets."""
    if not (path / "run.json").is_file():
        return None
    return int(open_dataset(path).scenes.count_rows(filter=pc.field("status") != "done"))


def _read_exported(dataset: Dataset, scene_id: str) -> MethodScene:
    exported = dataset.scene(scene_id)
    scene, meta = read_model_scene(exported.model()), exported.meta
    scales = {
        str(entry["object_id"]): _read_scale(entry, f"{scene_id}: meta.json") for entry in meta.get("objects", ())
    }
    objects = tuple(replace(item, baked_scale=scales.get(item.name, 1.0)) for item in scene.objects)
    camera = meta.get("camera_to_table")
    return replace(scene, objects=objects, camera_to_scene=None if camera is None else read_pose(camera))


def _read_scale(entry: Mapping[str, Any], where: str) -> float:
    scale = parse_finite(entry.get("scale"))
    if scale is None or scale <= 0.0:
        raise InputError(f"{where}: scale {entry.get('scale')!r:.60} of {entry['object_id']!r:.60}", "bad_meta")
    return scale


def read_pose(value: Mapping[str, Any]) -> Pose:
    """Read a pose of our JSON files; raise `bad_pose` for an invalid one."""
    try:
        given = LayoutPose.model_validate({key: value[key] for key in ("position", "quaternion_wxyz")})
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{value!r:.200} is not a pose: give position and quaternion_wxyz", "bad_pose") from error
    return Pose(np.array(given.position), normalize_quaternion(np.array(given.quaternion_wxyz)))


def read_mjcf(path: Path, root: Path | None = None) -> MethodScene:
    """Read the objects of an MJCF file with their collision shapes; it may name only files below `root`."""
    return read_model_scene(load_mjcf(path, root))


def read_model_scene(model: mujoco.MjModel) -> MethodScene:
    """Read the objects of a compiled model in its initial state: every solid body but the table.

    Fixed bodies count too, since they may overlap others.
    """
    contents = read_model_contents(model)
    fixed = tuple(its for its in contents.still if its.hulls and its.name != WORLD and not is_table(its.name))
    objects = tuple(_build_object(content) for content in (*contents.objects, *fixed) if content.looks)
    return MethodScene(objects, tuple(content.name for content in contents.still if content not in fixed))


def _build_object(content: ModelObject) -> MethodObject:
    mesh = concatenate_meshes([*(look.mesh for look in content.looks), *content.unseen])
    pieces = ConvexPieces(content.hulls, 1.0, 0.0, "given")
    return MethodObject(content.name, mesh, content.looks, content.pose, pieces=pieces)


def read_layout_scene(path: Path) -> MethodScene:
    """Read the objects of a layout file (`schemas.layout`)."""
    layout = read_layout_file(str(path.resolve()))
    meshes = read_layout_meshes(str(path.resolve()), layout, ObserveConfig())
    items = []
    for entry in layout.objects:
        mesh, pose = meshes[entry.mesh], read_pose(entry.pose.model_dump())
        items.append(MethodObject(entry.id, mesh, (VisualMesh(mesh, GREY),), pose, entry.scale))
    return MethodScene(tuple(items))


_READERS: dict[str, tuple[str, Callable[[Path], MethodScene]]] = {
    ".json": ("layout", read_layout_scene),
    ".glb": ("glb", read_glb_scene),
    ".xml": ("mjcf", read_mjcf),
}
