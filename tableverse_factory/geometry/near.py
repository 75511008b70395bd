"""The part of a closed mesh that matters to a neighbour: a solid of a few faces in place of thousands."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from schemas.geometry import TriangleMesh, Vector3

MOST = 0.5
"""With more of its vertices on the neighbour's side, the whole mesh is as good: it is made a solid once for all."""


def is_one_shell(mesh: TriangleMesh) -> bool:
    """Whether all its faces hang together."""
    n = len(mesh.vertices)
    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    edges = coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, label = connected_components(edges, directed=False)
    return bool((label[mesh.faces[:, 0]] == label[mesh.faces[0, 0]]).all())


def near(mesh: TriangleMesh, low: Vector3, high: Vector3) -> TriangleMesh | None:
    """A closed mesh that shares with whatever lies in a box exactly what the given one shares with it.

    One of the six half-spaces around the box is taken, the one that the mesh reaches into least. What does not reach
    into it is drawn together into one point, a vertex of the mesh beyond it: whatever becomes of the faces there, they
    stay beyond, for a half-space's complement is convex, and within the hull of the mesh.

    Args:
        mesh: Closed, of one shell.
        low: Lowest corner of the box.
        high: Highest corner.

    Returns:
        None where more than `MOST` of the vertices are in that half-space: nothing would be gained.
    """
    inside = min(
        (side for k in range(3) for side in (mesh.vertices[:, k] < high[k], mesh.vertices[:, k] > low[k])),
        key=np.count_nonzero,
    )
    if np.count_nonzero(inside) > MOST * len(inside):
        return None
    kept = np.zeros(len(inside), dtype=bool)
    kept[mesh.faces[inside[mesh.faces].any(axis=1)]] = True
    away = np.flatnonzero(~kept)
    if not len(away):
        return None
    number = np.full(len(kept), np.count_nonzero(kept), dtype=np.int32)
    number[kept] = np.arange(np.count_nonzero(kept), dtype=np.int32)
    faces = number[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return TriangleMesh(np.concatenate([mesh.vertices[kept], mesh.vertices[away[:1]]]), faces[whole])
