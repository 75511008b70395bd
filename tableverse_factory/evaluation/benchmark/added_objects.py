"""Scenes with objects of other scenes added to them, or their own objects moved, in memory."""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.evaluation.benchmark.benchmark import AddedObject
from tableverse_factory.physics.mjcf.load import parse_document
from tableverse_factory.physics.mjcf.portable_xml import find_or_add_child
from tableverse_factory.physics.mjcf.spec import ASSETS

PREFIX = "added_"
_FILED = ("mesh", "texture")  # elements of <asset> that name a file


def add_objects(scene: Scene, added: Sequence[tuple[Scene, AddedObject]]) -> Scene:
    """Add objects to a scene, each from the scene that it comes from; they are named `added_0`, `added_1` and on.

    The scene's own part of the MJCF stays as it is. Both scenes have to be exports of this factory.

    Raises:
        InputError: `bad_scene` if a scene has no such object, or the parts of both do not fit together.
    """
    if not added:
        return scene
    files, rows = scene.files(), scene.object_rows()
    root = parse_document(files)
    for number, (donor, thing) in enumerate(added):
        name = f"{PREFIX}{number}"
        if root.find(f".//body[@name='{name}']") is not None:
            raise InputError(f"scene {scene.scene_id} has a body {name!r} already", "bad_scene")
        files |= _add_object(root, donor, thing, name)
        rows = [*rows, {**_find_row(donor, thing.object_id), "object_id": name, **_name_pose(thing.pose)}]
    files["scene.xml"] = (ET.tostring(root, encoding="unicode") + "\n").encode()
    return Scene(scene.scene_id, scene.row, files, partial(_read_rows, scene, rows))


def move_objects(scene: Scene, poses: Mapping[str, np.ndarray]) -> Scene:
    """Move objects of a scene to other poses (position [m], quaternion wxyz) in the table frame, by id."""
    root = parse_document(scene.files())
    known = {row["object_id"]: row for row in scene.object_rows()}
    for name, pose in poses.items():
        body = root.find(f"./worldbody/body[@name='{name}']")
        if body is None or name not in known:
            raise InputError(f"scene {scene.scene_id} has no object {sanitize_line(name, 80)!r}", "bad_scene")
        row = pose.tolist()
        body.set("pos", _format(row[:3]))
        body.set("quat", _format(row[3:]))
        known[name] = {**known[name], **_name_pose(row)}
    rows = list(known.values())
    files = {**scene.files(), "scene.xml": (ET.tostring(root, encoding="unicode") + "\n").encode()}
    return Scene(scene.scene_id, scene.row, files, partial(_read_rows, scene, rows))


def _read_rows(scene: Scene, object_rows: list[dict[str, Any]], table: str) -> list[dict[str, Any]]:
    others = {"objects": lambda: object_rows, "tasks": scene.task_rows, "trajectories": scene.trajectory_rows}
    return others[table]()


def _find_row(donor: Scene, object_id: str) -> dict[str, Any]:
    for row in donor.object_rows():
        if row["object_id"] == object_id:
            return row
    raise InputError(f"scene {donor.scene_id} has no object {sanitize_line(object_id, 80)!r}", "bad_scene")


def _name_pose(pose: Sequence[float]) -> dict[str, float]:
    return dict(zip(("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"), pose, strict=True))


def _add_object(root: ET.Element, donor: Scene, thing: AddedObject, name: str) -> dict[str, bytes]:
    """Add the body with its assets to the document; return its files by their new names."""
    source = parse_document(donor.files())
    body = source.find(f"./worldbody/body[@name='{thing.object_id}']")
    if body is None:
        raise InputError(f"scene {donor.scene_id} has no body {sanitize_line(thing.object_id, 80)!r}", "bad_scene")
    _check_settings(root, source, donor.scene_id)
    body = copy.deepcopy(body)
    body.set("pos", _format(thing.pose[:3]))
    body.set("quat", _format(thing.pose[3:]))
    body.set("name", name)
    rename = partial(_rename, old=thing.object_id, new=name)
    for element in (*body.iter("geom"), *body.iter("joint")):
        element.set("name", rename(element.get("name", "")))
    taken = _take_assets(source, body, rename)
    find_or_add_child(root, "asset").extend(element for element, _ in taken)
    find_or_add_child(root, "worldbody").append(body)
    return {f"{ASSETS}/{element.get('file')}": _read(donor, old) for element, old in taken if old}


def _rename(text: str, old: str, new: str) -> str:
    """Rename what is named after an object, as its geoms, meshes and their files are, so that it is found as before."""
    return new + text.removeprefix(old) if text.startswith(old) else f"{new}_{text}"


def _take_assets(source: ET.Element, body: ET.Element, rename: Callable[[str], str]) -> list[tuple[ET.Element, str]]:
    """Copy the assets that a body names, with the files they had; names in the body are changed along."""
    found: list[tuple[ET.Element, str]] = []
    known: dict[tuple[str, str], str] = {}

    def take(kind: str, old: str) -> str:
        if (kind, old) not in known:
            element = copy.deepcopy(source.find(f"./asset/{kind}[@name='{old}']"))
            if element is None:
                raise InputError(f"scene.xml has no {kind} {sanitize_line(old, 80)!r}", "bad_mjcf")
            new, file = rename(old), element.get("file", "")
            element.set("name", new)
            if kind in _FILED and file:
                element.set("file", rename(file))
            known[kind, old] = new
            if kind == "material" and (texture := element.get("texture")):
                element.set("texture", take("texture", texture))
            found.append((element, file if kind in _FILED else ""))
        return known[kind, old]

    for geom in body.iter("geom"):
        for kind in ("mesh", "material"):
            if (old := geom.get(kind)) is not None:
                geom.set(kind, take(kind, old))
    return sorted(found, key=lambda item: ("texture", "material", "mesh").index(item[0].tag))


def _check_settings(root: ET.Element, source: ET.Element, scene_id: str) -> None:
    """Check that names of files and classes mean the same in both documents."""
    for kind in ("compiler", "default"):
        own, theirs = (_canonical(document.find(kind)) for document in (root, source))
        if own != theirs:
            raise InputError(f"scene {scene_id}: its <{kind}> is not that of the scene it is added to", "bad_scene")


def _canonical(element: ET.Element | None) -> str:
    return "" if element is None else ET.canonicalize(ET.tostring(element, encoding="unicode"), strip_text=True)


def _read(donor: Scene, file: str) -> bytes:
    files: Mapping[str, bytes] = donor.files()
    if f"{ASSETS}/{file}" not in files:
        raise InputError(f"scene {donor.scene_id} has no {ASSETS}/{sanitize_line(file, 80)}", "bad_scene")
    return files[f"{ASSETS}/{file}"]


def _format(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
