"""GLB scenes: an object per node, with colours, turned from y-up to z-up."""

import io
from collections.abc import Iterator
from pathlib import Path

import trimesh

from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.delivery.formats.model_contents import VisualMesh, is_table
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene
from tableverse_factory.geometry.math.transforms import Y_UP_TO_Z_UP, homogeneous_matrix, identity_pose
from tableverse_factory.geometry.mesh.mesh_colors import MaterialPart, merge_parts
from tableverse_factory.geometry.mesh.meshes import MAX_FACES, MAX_FILE_BYTES, MAX_PIXELS, check_mesh
from tableverse_factory.physics.mjcf.scenery import Rgb

GREY: Rgb = (178, 178, 184)


def read_glb_scene(path: Path) -> MethodScene:
    """Read the objects of a GLB file, z up, sorted by name; raise `bad_glb` if it holds no finite triangles.

    An object is a node with its descendants: the roots of the file, or, below a single root without a mesh of its own,
    the children of that root, and so on. Nodes named like a table (`TABLE_NAMES`) are left out.
    """
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{path.name}: {path.stat().st_size} bytes; at most {MAX_FILE_BYTES} are read", "bad_glb")
    try:
        # From memory, so that references to other files are not followed.
        scene = trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type="glb", process=False)
        _check_size(scene)
        items = [_build_object(scene, node) for node in sorted(_find_object_nodes(scene))]
    except Exception as error:
        raise InputError(f"{path.name} does not decode: {type(error).__name__}: {error}"[:500], "bad_glb") from error
    objects = tuple(item for item in items if not is_table(item.name))
    return MethodScene(objects, tuple(item.name for item in items if is_table(item.name)))


def _check_size(scene: trimesh.Scene) -> None:
    """Check the number of triangles before merging: a small file may instance one mesh thousands of times."""
    shown = (scene.geometry[scene.graph.get(node)[1]] for node in scene.graph.nodes_geometry)
    count = sum(len(its.faces) for its in shown if isinstance(its, trimesh.Trimesh))
    if count > MAX_FACES:
        raise GeometryError(f"{count} triangles; at most {MAX_FACES} are taken")


def _find_object_nodes(scene: trimesh.Scene) -> list[str]:
    children, geometry = scene.graph.transforms.children, scene.graph.transforms.node_data
    node, seen = scene.graph.base_frame, set[str]()
    while len(children.get(node, ())) == 1 and "geometry" not in geometry[node] and node not in seen:
        seen.add(node)
        only = children[node][0]
        if "geometry" in geometry[only] or not children.get(only):
            break
        node = only
    found = [child for child in children.get(node, ()) if any(True for _ in _iterate_geometry_nodes(scene, child))]
    return found or [node]


def _iterate_geometry_nodes(scene: trimesh.Scene, node: str) -> Iterator[str]:
    pending, seen = [node], set()
    while pending:
        current = pending.pop()
        if current in seen:  # a damaged file may have cycles
            continue
        seen.add(current)
        if "geometry" in scene.graph.transforms.node_data[current]:
            yield current
        pending.extend(reversed(scene.graph.transforms.children.get(current, ())))


def _build_object(scene: trimesh.Scene, node: str) -> MethodObject:
    parts = []
    for part in _iterate_geometry_nodes(scene, node):
        node_to_world, name = scene.graph.get(part)
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            parts.append(MaterialPart(geometry, homogeneous_matrix(Y_UP_TO_Z_UP) @ node_to_world))
    mesh = check_mesh(merge_parts(parts, MAX_PIXELS), node)
    return MethodObject(str(node), mesh, (VisualMesh(mesh, GREY),), identity_pose())
