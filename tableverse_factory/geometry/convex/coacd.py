"""CoACD (Wei et al., 2022), the paper's convex decomposition, with a reduced search."""

from types import ModuleType

import numpy as np

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.core.errors import GeometryError

THRESHOLD = 0.05  # concavity allowed, a share of the mesh's size: CoACD's default
MAX_FACES = 20_000
MAX_HULL_VERTICES = 64
_LIGHT_SEARCH = {"mcts_nodes": 10, "mcts_iterations": 40, "mcts_max_depth": 2, "resolution": 1000}


def load_coacd() -> ModuleType:
    """Import CoACD, quiet and after Open3D, which fails with `std::bad_cast` when it is loaded second."""
    import tableverse_factory.core.open3d_import  # noqa: F401
    import coacd  # isort: skip

    coacd.set_log_level("error")
    return coacd


def decompose_with_coacd(mesh: TriangleMesh, max_pieces: int) -> list[Points]:
    """Decompose a closed, oriented mesh of extent 1 into the corners of convex pieces, with a fixed seed.

    CoACD's own remeshing, which swells thin walls, is off.
    """
    if len(mesh.faces) > MAX_FACES:
        raise GeometryError(f"a mesh of {len(mesh.faces)} triangles is too large for CoACD: at most {MAX_FACES}")
    coacd = load_coacd()
    pieces = coacd.run_coacd(
        coacd.Mesh(np.array(mesh.vertices), np.array(mesh.faces)),
        threshold=THRESHOLD,
        max_convex_hull=max_pieces,
        preprocess_mode="off",
        max_ch_vertex=MAX_HULL_VERTICES,
        seed=0,
        **_LIGHT_SEARCH,
    )
    if not pieces:
        raise GeometryError(f"CoACD found no convex piece in a mesh of {len(mesh.faces)} triangles")
    return [np.asarray(vertices, dtype=np.float64) for vertices, _ in pieces]
