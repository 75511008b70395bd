"""Broad phase for two closed meshes, before they are made solids: a separating plane, or the parts that may overlap."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.geometry import Points, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb, aabb_size

MAX_CROPPED_SHARE = 0.5  # with more of its vertices in the half-space a mesh is used whole: its solid is made once
MAX_STEPS = 20  # of Gilbert's walk: a plane between two objects beside each other is nearly always found by the third

_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_TINY = np.finfo(np.float64).tiny
_APEX_OFFSET = np.array([0.0137, 0.0219, 0.0321])  # share of the extent: off every plane of symmetry


@dataclass(frozen=True, slots=True)
class OverlapSlab:
    """Overlap of two sets along a unit normal [m]: from the least of the first to the greatest of the second."""

    normal: Vector3
    low: float
    high: float

    @property
    def is_gap(self) -> bool:
        """Whether a plane separates the sets."""
        return self.low > self.high


def find_separating_slab(a: Points, b: Points) -> OverlapSlab:
    """Find a gap between two sets of points; else a slab that holds few points of both.

    Gilbert's walk (1966) towards the shortest difference of their hulls: each step is a direction. Where it finds no
    gap, the narrowest slab it saw is compared with those along the axes.
    """
    step = _box_middle(a) - _box_middle(b)
    narrow: OverlapSlab | None = None
    for _ in range(MAX_STEPS):
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
    return _find_emptiest_slab(a, b, [*_AXES, *([] if narrow is None else [narrow.normal])])


def crop_to_half_space(mesh: TriangleMesh, normal: Vector3, high: float) -> TriangleMesh | None:
    """Simplify a closed mesh of one shell outside a half-space; in it, `x @ normal < high`, the volume is the same.

    Vertices of faces that do not reach into the half-space collapse into one point far beyond it. As the complement of
    a half-space is convex, the collapsed faces stay beyond. The point lies off all planes of the mesh: manifold3d takes
    faces folded within a plane for degenerate and mends them wrongly. None beyond `MAX_CROPPED_SHARE`.
    """
    along = mesh.vertices @ normal
    inside = along < high
    if np.count_nonzero(inside) > MAX_CROPPED_SHARE * len(inside):
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
    extent = float(aabb_size(mesh.vertices).max())
    beyond = _box_middle(mesh.vertices) + extent * _APEX_OFFSET
    beyond += (float(along.max()) + extent - float(beyond @ normal)) * normal
    return TriangleMesh(np.concatenate([mesh.vertices[kept], beyond[None]]), faces[whole])


def _find_emptiest_slab(a: Points, b: Points, normals: Sequence[Vector3]) -> OverlapSlab:
    stacked = np.array(normals)
    along_a, along_b = a @ stacked.T, b @ stacked.T
    low, high = along_a.min(axis=0), along_b.max(axis=0)
    counts = np.count_nonzero(along_a < high, axis=0) + np.count_nonzero(along_b > low, axis=0)
    k = int(np.argmin(counts))
    return OverlapSlab(stacked[k], float(low[k]), float(high[k]))


def _box_middle(points: Points) -> Vector3:
    low, high = aabb(points)
    return (low + high) / 2
