"""Layout file, and its meshes, which are read from beside it alone."""

import posixpath
from functools import partial
from pathlib import Path

from fsspec.implementations.local import LocalFileSystem
from pydantic import ValidationError

from schemas.config import ObserveConfig
from schemas.error_text import describe_validation_error
from schemas.geometry import TriangleMesh
from schemas.layout import Layout
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.core.storage.files import resolve_filesystem
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_json, read_bytes
from tableverse_factory.sources.mesh_file import read_mesh_with_colors


def read_layout_file(uri: str) -> Layout:
    """Read and validate a layout; its meshes are not opened."""
    value = parse_json(read_bytes(uri, MAX_JSON_BYTES, "bad_layout"), uri.rsplit("/", 1)[-1], "bad_layout")
    try:
        return Layout.model_validate(value)
    except ValidationError as error:
        raise InputError(f"layout: {describe_validation_error(error)}"[:500], "bad_layout") from error


def resolve_mesh_uri(layout_uri: str, mesh: str) -> str:
    """Resolve the path of a mesh, relative to the layout and within the parent of its folder.

    Raises:
        InputError: `bad_mesh_path` for an absolute path, a URI, a backslash, or a path that climbs further.
    """
    up = posixpath.normpath(mesh)
    climbs = up.startswith("../../") or up in ("..", "../..")
    if posixpath.isabs(mesh) or "\\" in mesh or "://" in mesh or "::" in mesh or "\0" in mesh or climbs:
        remedy = "give a relative path with '/' that stays within the parent of the layout's folder"
        raise InputError(f"mesh {mesh[:200]!r}: {remedy}", "bad_mesh_path")
    filesystem, path = resolve_filesystem(layout_uri)
    target = posixpath.normpath(posixpath.join(posixpath.dirname(path), up))
    if isinstance(filesystem, LocalFileSystem):
        home = Path(path).parent.parent.resolve()
        if not Path(target).resolve().is_relative_to(home):
            raise InputError(f"mesh {mesh[:200]!r} is a link that leads out of {str(home)!r}", "bad_mesh_path")
    return str(filesystem.unstrip_protocol(target))


def read_layout_meshes(uri: str, layout: Layout, bounds: ObserveConfig) -> dict[str, TriangleMesh]:
    """Read every mesh of the layout once, by its path there, with the textures beside it."""
    meshes: dict[str, TriangleMesh] = {}
    for item in layout.objects:
        if item.mesh in meshes:
            continue
        data = read_bytes(resolve_mesh_uri(uri, item.mesh), bounds.max_file_bytes, "missing_mesh")
        try:
            meshes[item.mesh] = read_mesh_with_colors(item.mesh, data, partial(resolve_mesh_uri, uri), bounds)
        except GeometryError as error:
            raise InputError(f"{item.id}: {error}", "bad_mesh") from error
    return meshes
