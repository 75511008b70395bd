"""From any triangles to a closed solid, with a word for what had to be done."""

from collections.abc import Iterator

import manifold3d
import numpy as np
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import checked, from_trimesh, signed_volume, to_trimesh


def closed_mesh(mesh: TriangleMesh) -> tuple[TriangleMesh, str]:
    """A closed, outward-facing version of the mesh, and how it was repaired: empty, `merged`, `oriented`, `filled`.

    Raises:
        GeometryError: if it cannot be closed, or encloses nothing.
    """
    checked(mesh, "mesh")
    for note, candidate in _candidates(mesh):
        if as_solid(candidate).status() != manifold3d.Error.NoError:
            continue
        volume = signed_volume(candidate)
        if volume < 0.0:
            candidate, note = TriangleMesh(candidate.vertices, candidate.faces[:, ::-1].copy()), note or "oriented"
        if volume != 0.0:
            return candidate, note
    raise GeometryError(f"a mesh of {len(mesh.faces)} triangles cannot be closed")


def as_solid(mesh: TriangleMesh) -> manifold3d.Manifold:
    """The mesh as a manifold3d solid; `status()` says whether it is closed, and it is empty where it is not."""
    return manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices.copy(), mesh.faces.astype(np.uint64)))


def _candidates(mesh: TriangleMesh) -> Iterator[tuple[str, TriangleMesh]]:
    yield "", TriangleMesh(mesh.vertices, mesh.faces)
    loose = to_trimesh(TriangleMesh(mesh.vertices, mesh.faces))
    loose.merge_vertices()
    loose.update_faces(loose.nondegenerate_faces() & loose.unique_faces())
    loose.remove_unreferenced_vertices()
    yield "merged", from_trimesh(loose)
    trimesh.repair.fix_normals(loose)
    yield "oriented", from_trimesh(loose)
    trimesh.repair.fill_holes(loose)
    yield "filled", from_trimesh(loose)
