"""What several closed shells enclose together: overlaps once, hollows not, whichever way they are turned."""

import manifold3d

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.repair import as_mesh, as_solid, outward

HOLLOW_SHARE = 0.01
"""A shell that is inside out bounds a hollow if no more than this share of it is outside what is around it."""
SAME_SHARE = 1e-9
"""Volumes that differ by no more than this share are the same."""


def bounded_by_shells(mesh: TriangleMesh) -> TriangleMesh:
    """A surface around what a closed mesh of several shells encloses; the mesh itself where nothing is amiss with it.

    The largest shell first, each adds what it encloses. One that is inside out and within what is there already takes
    it away instead: it bounds a hollow, in which there may be further shells. Elsewhere it was turned the wrong way.
    """
    shells = as_solid(mesh).decompose()
    united = manifold3d.Manifold()
    for shell in sorted(shells, key=lambda shell: -abs(float(shell.volume()))):
        if shell.volume() >= 0.0:
            united += shell
            continue
        turned = outward(shell)
        is_hollow = (turned - united).volume() <= HOLLOW_SHARE * turned.volume()
        united = united - turned if is_hollow else united + turned
    volume = float(united.volume())
    if abs(sum(float(shell.volume()) for shell in shells) - volume) <= SAME_SHARE * volume:
        return mesh
    return as_mesh(united)
