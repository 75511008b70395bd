"""The shells of a mesh, and what several closed ones enclose together: overlaps once, hollows not."""

import manifold3d
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from schemas.geometry import Faces, TriangleMesh
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.geometry.mesh.repair import as_mesh, as_solid, outward

WITHIN_SHARE = 0.01
"""A shell is within others if no more than this share of it is outside them."""
SAME_SHARE = 1e-9
"""Volumes that differ by no more than this share are the same."""
REMEMBERED_BYTES = 4 * 1024
"""Yes or no for the meshes of some scenes."""


def is_one_shell(mesh: TriangleMesh) -> bool:
    """Whether all its faces hang together."""
    return _is_one_shell(mesh.faces)


@memoize_by_content(REMEMBERED_BYTES)
def _is_one_shell(faces: Faces) -> bool:
    """Asked of the same triangles by three stages, wherever their corners are."""
    n = int(faces.max(initial=0)) + 1
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    edges = coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, label = connected_components(edges, directed=False)
    return bool((label[faces[:, 0]] == label[faces[:1, 0]]).all())


def bounded_by_shells(mesh: TriangleMesh) -> TriangleMesh:
    """A surface around what a closed mesh of several shells encloses; the mesh itself where nothing is amiss with it.

    The outward shells that lie in no larger one that is inside out are united first. One that is inside out and within
    them bounds a hollow, which is taken away; elsewhere it was turned the wrong way and adds what it encloses. What
    lies in hollows is added, from the outside in. An inner wall that is turned outwards bounds no hollow.
    """
    shells = as_solid(mesh).decompose()
    turned = [outward(shell) for shell in shells if shell.volume() < 0.0]
    first, others = manifold3d.Manifold(), []
    for shell in shells:
        is_outward, solid = shell.volume() >= 0.0, outward(shell)
        if is_outward and not any(solid.volume() < hull.volume() and _within(solid, hull) for hull in turned):
            first += solid
        else:
            others.append((is_outward, solid))
    united = first
    for is_outward, solid in sorted(others, key=lambda other: -float(other[1].volume())):
        united = united - solid if not is_outward and _within(solid, first) else united + solid
    volume = float(united.volume())
    if abs(sum(float(shell.volume()) for shell in shells) - volume) <= SAME_SHARE * volume:
        return mesh
    return as_mesh(united)


def _within(solid: manifold3d.Manifold, others: manifold3d.Manifold) -> bool:
    return bool((solid - others).volume() <= WITHIN_SHARE * solid.volume())
