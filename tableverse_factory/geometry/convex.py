"""A mesh as few convex pieces: what the simulator feels."""

from pathlib import Path

import coacd
import manifold3d
import numpy as np

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, TriangleMesh
from tableverse_factory.geometry.repair import as_solid, closed_mesh

NEARLY_CONVEX = 1.06
MAX_HULL_VERTICES = 64


def decompose(mesh: TriangleMesh, config: RectifyConfig, cache_dir: Path) -> ConvexPieces:  # noqa: ARG001
    """Convex pieces that cover the mesh, in the mesh's own frame and at scale 1.

    Raises:
        GeometryError: if the mesh cannot be made a solid.
    """
    closed, repaired = closed_mesh(mesh)
    solid = as_solid(closed)
    hull = solid.hull()
    if hull.volume() <= NEARLY_CONVEX * solid.volume():
        return _pieces([hull], solid, "convex", repaired)
    simple = solid.simplify(0.002 * float(np.ptp(mesh.vertices, axis=0).max())).to_mesh64()
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(np.array(simple.vert_properties[:, :3]), np.array(simple.tri_verts)),
        preprocess_mode="off",
        resolution=500,
        mcts_nodes=5,
        mcts_iterations=20,
        mcts_max_depth=1,
        max_ch_vertex=MAX_HULL_VERTICES,
        decimate=True,
    )
    hulls = [manifold3d.Manifold.hull_points(np.array(vertices)) for vertices, _ in parts]
    return _pieces(hulls, solid, "coacd", repaired)


def _pieces(hulls: list[manifold3d.Manifold], solid: manifold3d.Manifold, method: str, repaired: str) -> ConvexPieces:
    union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
    meshes = []
    for hull in hulls:
        flat = hull.simplify(0.0).to_mesh64()
        meshes.append(TriangleMesh(np.array(flat.vert_properties[:, :3]), np.array(flat.tri_verts, dtype=np.int32)))
    return ConvexPieces(tuple(meshes), float(union.volume() / solid.volume()), 0.0, method, repaired)
