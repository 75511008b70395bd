"""Mesh file with the materials of an OBJ and their pictures."""

import posixpath
import re
from collections.abc import Callable, Iterator, Mapping

from schemas.config import ObserveConfig
from schemas.geometry import TriangleMesh
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, exists, open_image, read_bytes
from tableverse_factory.geometry.mesh.meshes import read_mesh

MAX_PICTURES = 64  # Pictures that one material file may name; further ones are not read
_MATERIAL_FILE = re.compile(rb"^[ \t]*mtllib[ \t]+(\S[^\r\n]*)", re.MULTILINE)
_DIFFUSE_MAP = re.compile(rb"^[ \t]*map_Kd[ \t]+(\S[^\r\n]*)", re.MULTILINE)

Locate = Callable[[str], str]
"""Resolves a path, relative to the file that names the mesh, to a URI; raises where the path leads too far."""


def read_mesh_with_colors(name: str, data: bytes, locate: Locate, bounds: ObserveConfig) -> TriangleMesh:
    """Read a mesh with its materials and pictures."""
    materials = read_material_files(name, data, locate, bounds)
    for picture in sorted(set(materials) - set(_find_names(_MATERIAL_FILE, data, 1) if materials else ())):
        open_image(materials[picture], f"{name}: texture {picture[:200]!r}", bounds, "bad_texture")
    return read_mesh(data, name, materials, bounds.max_pixels)


def read_material_files(name: str, data: bytes, locate: Locate, bounds: ObserveConfig) -> Mapping[str, bytes]:
    """Read the material file of an OBJ and the pictures it names, by their names there; missing ones are left out."""
    found: dict[str, bytes] = {}
    if not name.lower().endswith(".obj") or b"mtllib" not in data:
        return found
    for library in _find_names(_MATERIAL_FILE, data, 1):
        path = posixpath.join(posixpath.dirname(name), library)
        if not exists(uri := locate(path)):
            continue
        found[library] = read_bytes(uri, MAX_JSON_BYTES, "bad_texture")
        for picture in _find_names(_DIFFUSE_MAP, found[library], MAX_PICTURES):
            if exists(uri := locate(posixpath.join(posixpath.dirname(path), picture))):
                found[picture] = read_bytes(uri, bounds.max_file_bytes, "bad_texture")
    return found


def _find_names(pattern: re.Pattern[bytes], text: bytes, most: int) -> Iterator[str]:
    for index, match in enumerate(pattern.finditer(text)):
        if index >= most:
            return
        yield match.group(1).strip().decode("utf-8", "replace")
