"""Triangle meshes: reading untrusted files, bounds, volume, and the bridge to trimesh."""

import io
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import trimesh
from PIL import Image

from schemas.geometry import Pose, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb, aabb_size
from tableverse_factory.geometry.math.transforms import Y_UP_TO_Z_UP, transform_points
from tableverse_factory.geometry.mesh.glb_pictures import check_glb_pictures
from tableverse_factory.geometry.mesh.mesh_colors import MaterialPart, merge_parts
from tableverse_factory.geometry.mesh.plain_obj import read_plain_obj

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb")
MAX_FILE_BYTES = 512 * 1024 * 1024
MAX_FACES = 5_000_000
MAX_PIXELS = 40_000_000
MAX_EXTENT_M = 1000.0
MAX_COORDINATE_M = 1e5


def read_mesh(
    data: bytes, file_name: str, beside: Mapping[str, bytes] | None = None, max_pixels: int = MAX_PIXELS
) -> TriangleMesh:
    """Decode an untrusted OBJ, PLY, STL or GLB file into one mesh with its colours; GLB is turned from Y-up to Z-up.

    The ending of the name tells the format. `beside` holds the material file and the pictures that an OBJ names, by the
    names there. Whatever is wrong with a file, the error is a `GeometryError`.
    """
    suffix = PurePosixPath(file_name).suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise GeometryError(f"mesh {file_name!r}: unknown ending {suffix!r}; give one of {', '.join(MESH_SUFFIXES)}")
    if len(data) > MAX_FILE_BYTES:
        raise GeometryError(f"mesh {file_name!r}: {len(data)} bytes; at most {MAX_FILE_BYTES} are read")
    if suffix == ".obj" and (plain := read_plain_obj(data)) is not None:
        return check_mesh(plain, file_name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own bound decides
            if suffix == ".glb":
                check_glb_pictures(data)
            scene = trimesh.load_scene(
                io.BytesIO(data),
                file_type=suffix[1:],
                resolver=_MemoryResolver(beside or {}),
                process=False,
                skip_materials=suffix == ".obj" and not beside,
            )
            mesh = merge_parts(_collect_parts(scene), max_pixels)
    except Exception as error:
        raise GeometryError(f"mesh {file_name!r} does not decode: {type(error).__name__}: {error}"[:500]) from error
    if suffix == ".glb":
        mesh = replace(mesh, vertices=mesh.vertices @ Y_UP_TO_Z_UP.T)
    return check_mesh(mesh, file_name)


class _MemoryResolver(trimesh.resolvers.Resolver):  # type: ignore[misc]
    """Files in memory, the only ones that trimesh may read, whatever the folder; none is written."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        self._files = files

    def get(self, name: str) -> bytes:
        if name not in self._files:
            raise FileNotFoundError(name)
        return self._files[name]

    def keys(self) -> Iterable[str]:
        return self._files.keys()

    def write(self, name: str, data: bytes) -> None:  # noqa: ARG002
        raise PermissionError(name)

    def namespaced(self, namespace: str) -> "_MemoryResolver":  # noqa: ARG002
        return self


def _collect_parts(scene: trimesh.Scene) -> list[MaterialPart]:
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    parts = [MaterialPart(scene.geometry[name], matrix) for matrix, name in placed]
    parts = [part for part in parts if isinstance(part.mesh, trimesh.Trimesh) and len(part.mesh.faces)]
    if (count := sum(len(part.mesh.faces) for part in parts)) > MAX_FACES:
        raise GeometryError(f"{count} triangles; at most {MAX_FACES} are taken")
    return parts


def check_mesh(mesh: TriangleMesh, name: str) -> TriangleMesh:
    """Return the mesh, without vertices of no face, if it is usable; else raise a `GeometryError`."""
    problem = _find_broken_faces(mesh)
    if not problem:
        mesh = _drop_loose_vertices(mesh)
        problem = _find_bad_size(mesh)
    if problem:
        raise GeometryError(f"mesh {name!r} {problem}")
    return mesh


def _find_broken_faces(mesh: TriangleMesh) -> str:
    if len(mesh.faces) == 0 or len(mesh.vertices) == 0:
        return "has no triangles"
    if len(mesh.faces) > MAX_FACES:
        return f"has {len(mesh.faces)} triangles; at most {MAX_FACES} are taken"
    if int(mesh.faces.min()) < 0 or int(mesh.faces.max()) >= len(mesh.vertices):
        return "has faces that point to missing vertices"
    return ""


def _drop_loose_vertices(mesh: TriangleMesh) -> TriangleMesh:
    """Drop the vertices of no face: boxes and lowest points are measured over all vertices."""
    used = np.zeros(len(mesh.vertices), dtype=bool)
    used[mesh.faces] = True
    if used.all():
        return mesh
    faces = (np.cumsum(used, dtype=np.int32) - 1)[mesh.faces]
    colors = None if mesh.vertex_colors is None else mesh.vertex_colors[used]
    return replace(mesh, vertices=mesh.vertices[used], faces=faces, vertex_colors=colors)


def _find_bad_size(mesh: TriangleMesh) -> str:
    if not np.isfinite(mesh.vertices).all():
        return "holds vertices that are NaN or infinite"
    farthest = float(np.abs(mesh.vertices).max())
    if farthest > MAX_COORDINATE_M:
        return f"reaches {farthest:g} m from its origin; at most {MAX_COORDINATE_M:g} make sense"
    extent = float(aabb_size(mesh.vertices).max())
    if not 0.0 < extent <= MAX_EXTENT_M:
        return f"is {extent:g} m large; give metres, more than 0 and at most {MAX_EXTENT_M:g}"
    return ""


def from_trimesh(mesh: trimesh.Trimesh) -> TriangleMesh:
    """Copy a trimesh, vertex colours included where it has them."""
    colors = None
    if getattr(mesh, "visual", None) is not None and mesh.visual.kind == "vertex":
        colors = np.ascontiguousarray(mesh.visual.vertex_colors[:, :3], dtype=np.uint8)
    vertices = np.array(mesh.vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces, dtype=np.int32).reshape(-1, 3)
    return TriangleMesh(vertices, faces, colors)


def to_trimesh(mesh: TriangleMesh) -> trimesh.Trimesh:
    """Make an unprocessed trimesh that shares no memory with the mesh."""
    return trimesh.Trimesh(
        mesh.vertices.copy(), mesh.faces.copy(), vertex_colors=mesh.vertex_colors, process=False, validate=False
    )


def place_mesh(mesh: TriangleMesh, pose: Pose, scale: float = 1.0) -> TriangleMesh:
    """Transform a mesh to the parent frame of `pose`."""
    return replace(mesh, vertices=transform_points(pose, mesh.vertices, scale))


def concatenate_meshes(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Join meshes into one without colours; empty where there are none."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
    return TriangleMesh(vertices, np.concatenate([np.empty((0, 3), dtype=np.int32), *faces]).astype(np.int32))


def box_center(mesh: TriangleMesh) -> Vector3:
    """Centre of the axis-aligned box [m]."""
    low, high = aabb(mesh.vertices)
    return (low + high) / 2
