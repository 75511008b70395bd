"""Shells of a mesh: how many there are, and the volume that several enclose, overlaps once and hollows excluded."""

import manifold3d
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from schemas.geometry import Faces, TriangleMesh
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.geometry.mesh.repair import mesh_to_solid, orient_outward, solid_to_mesh

WITHIN_SHARE = 0.01  # a shell is within others if no more than this share of it is outside them
SAME_SHARE = 1e-9  # volumes that differ by no more than this share are the same
REMEMBERED_BYTES = 4 * 1024  # one flag for each mesh of some scenes


def is_one_shell(mesh: TriangleMesh) -> bool:
    """Whether all faces are connected."""
    return _is_one_shell(mesh.faces)


@memoize_by_content(REMEMBERED_BYTES)
def _is_one_shell(faces: Faces) -> bool:
    """Cached by the triangles alone: three stages need it for the same ones."""
    n = int(faces.max(initial=0)) + 1
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    edges = coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, label = connected_components(edges, directed=False)
    return bool((label[faces[:, 0]] == label[faces[:1, 0]]).all())


def unite_shells(mesh: TriangleMesh) -> TriangleMesh:
    """Make one surface of a closed mesh of several shells; the mesh itself where its shells are consistent.

    Outward shells that lie in no larger inverted one are united first. An inverted shell within them bounds a hollow,
    which is subtracted; elsewhere it was inverted by mistake and is added. Then shells in hollows are added, from
    outside in. An inner wall that is turned outwards bounds no hollow.
    """
    shells = mesh_to_solid(mesh).decompose()
    turned = [orient_outward(shell) for shell in shells if shell.volume() < 0.0]
    first, others = manifold3d.Manifold(), []
    for shell in shells:
        is_outward, solid = shell.volume() >= 0.0, orient_outward(shell)
        if is_outward and not any(solid.volume() < hull.volume() and _is_within(solid, hull) for hull in turned):
            first += solid
        else:
            others.append((is_outward, solid))
    united = first
    for is_outward, solid in sorted(others, key=lambda other: -float(other[1].volume())):
        united = united - solid if not is_outward and _is_within(solid, first) else united + solid
    volume = float(united.volume())
    if abs(sum(float(shell.volume()) for shell in shells) - volume) <= SAME_SHARE * volume:
        return mesh
    return solid_to_mesh(united)


def _is_within(solid: manifold3d.Manifold, others: manifold3d.Manifold) -> bool:
    return bool((solid - others).volume() <= WITHIN_SHARE * solid.volume())
