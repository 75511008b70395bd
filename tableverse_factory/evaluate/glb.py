"""GLB scenes: an object per node, in colour, turned from Y-up to Z-up."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float64

from schemas.geometry import Texture, TriangleMesh
from tableverse_factory.errors import InputError
from tableverse_factory.evaluate.scenes import Item, Scene
from tableverse_factory.formats.contents import Look, is_table
from tableverse_factory.geometry.meshes import MAX_FILE_BYTES, checked, from_trimesh
from tableverse_factory.geometry.transforms import identity_pose
from tableverse_factory.physics.scenery import Rgb
from tableverse_factory.physics.things import joined

Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
GREY: Rgb = (178, 178, 184)


def read_glb_scene(path: Path) -> Scene:
    """The objects of a GLB file as they stand, z up, sorted by name.

    An object is a node with all below it: the roots of the file, or, below a root that stands alone and has no mesh of
    its own, that root's children, and so on down. Nodes named like a table (`TABLE_NAMES`) are left out.

    Raises:
        InputError: `bad_glb` if it does not decode, or holds no finite triangles.
    """
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{path.name}: {path.stat().st_size} bytes; at most {MAX_FILE_BYTES} are read", "bad_glb")
    try:
        scene = trimesh.load_scene(path, file_type="glb", process=False)
        items = [_item(scene, node) for node in sorted(_object_nodes(scene))]
    except Exception as error:
        raise InputError(f"{path.name} does not decode: {type(error).__name__}: {error}"[:500], "bad_glb") from error
    objects = tuple(item for item in items if not is_table(item.name))
    return Scene(objects, tuple(item.name for item in items if is_table(item.name)))


def _object_nodes(scene: trimesh.Scene) -> list[str]:
    """The nodes that stand for objects."""
    children, geometry = scene.graph.transforms.children, scene.graph.transforms.node_data
    node = scene.graph.base_frame
    while len(children.get(node, ())) == 1 and "geometry" not in geometry[node]:
        only = children[node][0]
        if "geometry" in geometry[only] or not children.get(only):
            break
        node = only
    found = [child for child in children.get(node, ()) if any(True for _ in _geometry_nodes(scene, child))]
    return found or [node]


def _geometry_nodes(scene: trimesh.Scene, node: str) -> Iterator[str]:
    waiting = [node]
    while waiting:
        here = waiting.pop()
        if "geometry" in scene.graph.transforms.node_data[here]:
            yield here
        waiting.extend(reversed(scene.graph.transforms.children.get(here, ())))


def _item(scene: trimesh.Scene, node: str) -> Item:
    looks = []
    for part in _geometry_nodes(scene, node):
        node_to_world, name = scene.graph.get(part)
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            looks.append(_look(geometry, Y_UP_TO_Z_UP @ node_to_world))
    mesh = checked(joined([look.mesh for look in looks]), node)
    return Item(str(node), mesh, tuple(looks), identity_pose())


def _look(geometry: trimesh.Trimesh, to_scene: Float64[np.ndarray, "4 4"]) -> Look:
    mesh = from_trimesh(geometry)
    mesh = replace(mesh, vertices=mesh.vertices @ to_scene[:3, :3].T + to_scene[:3, 3])
    if np.linalg.det(to_scene[:3, :3]) < 0.0:  # mirrored: the faces would look inwards
        mesh = replace(mesh, faces=mesh.faces[:, ::-1].copy())
        geometry = geometry.copy()
        geometry.faces = geometry.faces[:, ::-1]
    texture, color = _surface(geometry)
    return Look(mesh if texture is None else TriangleMesh(mesh.vertices, mesh.faces, None, texture), color)


def _surface(geometry: trimesh.Trimesh) -> tuple[Texture | None, Rgb]:
    """The picture on a mesh, and its one colour where it has none."""
    visual = geometry.visual
    if visual.kind != "texture":
        return None, GREY
    material = visual.material
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    color = _rgb(getattr(material, "main_color", None))
    if picture is None or visual.uv is None:
        return None, color
    uv = np.asarray(visual.uv, dtype=np.float64)[:, :2]
    corners = uv[geometry.faces]
    corners = corners - np.floor(corners.mean(axis=1, keepdims=True))  # a repeated picture: back to its first copy
    return Texture(np.asarray(picture.convert("RGB")), corners), color


def _rgb(color: Any) -> Rgb:
    if color is None:
        return GREY
    red, green, blue = (int(value) for value in np.asarray(color).ravel()[:3])
    return red, green, blue
