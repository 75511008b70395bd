"""Repair of meshes: from any triangles to a closed solid, with the name of the repair."""

from collections.abc import Callable

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Int64

from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.manifold_threads import limit_manifold_threads
from tableverse_factory.geometry.mesh.meshes import check_mesh, from_trimesh, to_trimesh
from tableverse_factory.geometry.mesh.remesh import remesh
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area

limit_manifold_threads()

MIN_FILL_SHARE = 1e-7  # a solid that fills less of the cube of its extent is flat: remeshing gives it body
MAX_CAP_SHARE = 0.25  # most share of the surface that caps may have: an open bowl of one sheet must stay open
MAX_FACES_STITCHED = 300_000  # larger broken meshes are remeshed at once: finding neighbouring faces would take minutes


def make_closed_solid(mesh: TriangleMesh) -> tuple[manifold3d.Manifold, str]:
    """Make a closed solid of positive volume of a mesh, in its own frame, and tell how it was repaired.

    The least repair that works is taken: none (empty), `merged` (vertices that coincide), `oriented` (faces turned),
    `filled` (small holes capped), `remeshed` (voxels). Shells inside one another or overlapping count as one body.

    Raises:
        GeometryError: if the mesh has no finite triangles, or encloses nothing even then.
    """
    check_mesh(mesh, "mesh")
    low, high = aabb(mesh.vertices)
    center, size = (low + high) / 2, float((high - low).max())
    solid = _unite_shells(mesh_to_solid(mesh))
    if abs(solid.volume()) > MIN_FILL_SHARE * size**3:
        return solid, ""
    shape = TriangleMesh((mesh.vertices - center) / size, mesh.faces)  # tolerances of what follows are absolute
    for note, repair in _REPAIRS:
        solid = _unite_shells(mesh_to_solid(repair(shape)))
        if abs(solid.volume()) > MIN_FILL_SHARE:
            return solid.scale([size] * 3).translate(center), note
    raise GeometryError(f"a mesh of {len(mesh.faces)} triangles encloses nothing, even where it is remeshed")


def mesh_to_solid(mesh: TriangleMesh) -> manifold3d.Manifold:
    """Convert a mesh to a manifold3d solid; empty where it is not closed."""
    return manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices.copy(), mesh.faces.astype(np.uint64)))


def solid_to_mesh(solid: manifold3d.Manifold) -> TriangleMesh:
    """Convert a solid to its surface."""
    mesh = solid.to_mesh64()
    return TriangleMesh(np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int32))


def orient_outward(shell: manifold3d.Manifold) -> manifold3d.Manifold:
    """Turn a shell that is inside out."""
    if shell.volume() >= 0.0:
        return shell
    mesh = solid_to_mesh(shell)
    return mesh_to_solid(TriangleMesh(mesh.vertices, mesh.faces[:, ::-1].copy()))


def _unite_shells(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    shells = [orient_outward(shell) for shell in solid.decompose()]
    if len(shells) < 2:
        return shells[0] if shells else solid
    return manifold3d.Manifold.batch_boolean(shells, manifold3d.OpType.Add)


def _orient_faces(mesh: TriangleMesh) -> TriangleMesh:
    tidied = _tidy(mesh)
    if len(tidied.faces) <= MAX_FACES_STITCHED:
        trimesh.repair.fix_winding(tidied)
    return from_trimesh(tidied)


def _tidy(mesh: TriangleMesh) -> trimesh.Trimesh:
    loose = to_trimesh(mesh)
    loose.merge_vertices()
    loose.update_faces(loose.nondegenerate_faces() & loose.unique_faces())
    loose.remove_unreferenced_vertices()
    return loose


def _cap_holes(mesh: TriangleMesh) -> TriangleMesh:
    """Close each boundary loop by a fan around its centre, if all fans together are small."""
    if len(mesh.faces) > MAX_FACES_STITCHED:
        return mesh
    vertices, faces = [mesh.vertices], [mesh.faces]
    cap_area = 0.0
    for loop in _find_boundary_loops(mesh):
        ring = mesh.vertices[loop]
        center = ring.mean(axis=0)
        following = np.roll(loop, -1)
        apex = np.full_like(loop, sum(len(part) for part in vertices))
        vertices.append(center[None])
        faces.append(np.stack([following, loop, apex], axis=1).astype(np.int32))
        spokes = np.cross(ring - center, mesh.vertices[following] - center)
        cap_area += float(np.linalg.norm(spokes, axis=1).sum()) / 2
    if cap_area > MAX_CAP_SHARE * compute_surface_area(mesh):
        return mesh
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))


def _find_boundary_loops(mesh: TriangleMesh) -> list[Int64[np.ndarray, " n"]]:
    """Find closed chains of edges of one face each, in its direction; none passes a vertex twice."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).tolist()
    known = {(a, b) for a, b in edges}
    onward: dict[int, list[int]] = {}
    for a, b in edges:
        if (b, a) not in known:
            onward.setdefault(a, []).append(b)
    loops = []
    for start in list(onward):
        chain = [start]
        while onward.get(chain[-1]):
            chain.append(onward[chain[-1]].pop())
            first = chain.index(chain[-1])
            if first < len(chain) - 1:  # back at a vertex of the chain: what lies between is a loop
                loops.append(np.array(chain[first:-1], dtype=np.int64))
                del chain[first + 1 :]
    return [loop for loop in loops if len(loop) > 2]


_REPAIRS: tuple[tuple[str, Callable[[TriangleMesh], TriangleMesh]], ...] = (
    ("merged", lambda mesh: from_trimesh(_tidy(mesh))),
    ("oriented", _orient_faces),
    ("filled", lambda mesh: _cap_holes(_orient_faces(mesh))),
    ("remeshed", remesh),
)
