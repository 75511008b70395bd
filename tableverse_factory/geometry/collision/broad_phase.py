"""What two closed meshes have to do with each other, before they are made solids.

Nothing, where a plane parts them; else the parts of them that matter, a few faces in place of thousands.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.geometry import Points, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb, size_around

MOST = 0.5
"""With more of its vertices on the neighbour's side, the whole mesh is as good: it is made a solid once for all."""

STEPS = 20
"""A plane between two things that stand beside each other is nearly always found by the third."""

_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_TINY = np.finfo(np.float64).tiny

_ASKEW = np.array([0.0137, 0.0219, 0.0321])
"""Off every plane of symmetry, as a share of the extent."""


@dataclass(frozen=True, slots=True)
class OverlapSlab:
    """Where two sets of points overlap along a direction.

    Attributes:
        normal: The direction, a unit vector.
        low: The first set has nothing before it [m].
        high: The second set has nothing beyond it [m].
    """

    normal: Vector3
    low: float
    high: float

    @property
    def is_gap(self) -> bool:
        """Whether a plane parts the sets, so that their hulls share nothing."""
        return self.low > self.high


def slab_between(a: Points, b: Points) -> OverlapSlab:
    """A gap between two sets of points, if one is soon found; else a slab that holds few points of both.

    Gilbert's walk (1966) towards the shortest difference of their hulls: each step is a direction. Where it finds no
    gap, the narrowest slab it saw is compared with those along the axes.
    """
    step = _middle(a) - _middle(b)
    narrow: OverlapSlab | None = None
    for _ in range(STEPS):
        length = float(np.linalg.norm(step))
        if length == 0.0:
            break
        normal = step / length
        along_a, along_b = a @ normal, b @ normal
        first, last = int(along_a.argmin()), int(along_b.argmax())
        slab = OverlapSlab(normal, float(along_a[first]), float(along_b[last]))
        if slab.is_gap:
            return slab
        if narrow is None or slab.high - slab.low < narrow.high - narrow.low:
            narrow = slab
        onward = a[first] - b[last] - step
        step = step + min(max(-float(step @ onward) / max(float(onward @ onward), _TINY), 0.0), 1.0) * onward
    return _emptiest(a, b, [*_AXES, *([] if narrow is None else [narrow.normal])])


def overlapping_regions(mesh: TriangleMesh, normal: Vector3, high: float) -> TriangleMesh | None:
    """A closed mesh that bounds the same volume as the given one where `x @ normal < high`, and any beyond.

    What does not reach into that half-space is drawn together into one point far beyond it: whatever becomes of the
    faces there, they stay beyond, for a half-space's complement is convex. The point is none of the mesh's own and lies
    askew, or faces would be folded within a plane of the mesh, which manifold3d takes for degenerate and mends wrongly.

    Args:
        mesh: Closed, of one shell.
        normal: A unit vector.
        high: Where the half-space ends [m].

    Returns:
        None where more than `MOST` of the vertices are in the half-space: nothing would be gained.
    """
    along = mesh.vertices @ normal
    inside = along < high
    if np.count_nonzero(inside) > MOST * len(inside):
        return None
    kept = np.zeros(len(inside), dtype=bool)
    kept[mesh.faces[inside[mesh.faces].any(axis=1)]] = True
    if kept.all():
        return None
    count = np.count_nonzero(kept)
    number = np.full(len(kept), count, dtype=np.int32)
    number[kept] = np.arange(count, dtype=np.int32)
    faces = number[mesh.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    extent = float(size_around(mesh.vertices).max())
    beyond = _middle(mesh.vertices) + extent * _ASKEW
    beyond += (float(along.max()) + extent - float(beyond @ normal)) * normal
    return TriangleMesh(np.concatenate([mesh.vertices[kept], beyond[None]]), faces[whole])


def _emptiest(a: Points, b: Points, normals: Sequence[Vector3]) -> OverlapSlab:
    """Of the slabs across some directions, the one that holds the fewest points."""
    stacked = np.array(normals)
    along_a, along_b = a @ stacked.T, b @ stacked.T
    low, high = along_a.min(axis=0), along_b.max(axis=0)
    counts = np.count_nonzero(along_a < high, axis=0) + np.count_nonzero(along_b > low, axis=0)
    k = int(np.argmin(counts))
    return OverlapSlab(stacked[k], float(low[k]), float(high[k]))


def _middle(points: Points) -> Vector3:
    low, high = aabb(points)
    middle: Vector3 = (low + high) / 2
    return middle
