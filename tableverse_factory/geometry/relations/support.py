"""Who carries whom: contacts whose normals point mostly upwards, on meshes and on convex pieces."""

from collections.abc import Iterator, Sequence

import numpy as np
import open3d as o3d

from schemas.geometry import Points, TriangleMesh, Vector3
from tableverse_factory.geometry.collision.solids import Solids, meetings
from tableverse_factory.geometry.mesh.height_maps import Caster, column_caster
from tableverse_factory.geometry.mesh.meshes import bounds
from tableverse_factory.geometry.mesh.surface_samples import surface_samples

Pairs = frozenset[tuple[int, int]]
"""(carried, carrier), indices of bodies."""

REACH_M = 0.002
"""Surfaces this near touch: a layout that was never simulated keeps gaps of this order."""
UPWARD = 0.5
"""Least vertical part of the unit normal of a contact that carries: 30° above the horizontal.

What leans on another thing at a steeper angle is held by it, but not carried.
"""
SAMPLES = 4000
"""Points on each surface: 1 to 3 mm apart on household things."""
TOUCHING_M = 0.0002
"""Below this the way between two surfaces has no direction to speak of; their normals decide alone."""


def carried_by_meshes(meshes: Sequence[TriangleMesh]) -> Pairs:
    """Pairs of meshes that touch, the contact's normal pointing up from one into the other.

    The normal is the mean over all points of either surface within `REACH_M` of the other, the nearest counting most.

    Args:
        meshes: As they stand in the table frame, z up, faces counter-clockwise from outside.
    """
    boxes = [bounds(mesh) for mesh in meshes]
    samples = [surface_samples(mesh, SAMPLES)[0] for mesh in meshes]
    casters = [column_caster(mesh) for mesh in meshes]
    pairs = set()
    for i in range(len(meshes)):
        for j in range(i + 1, len(meshes)):
            if any((boxes[i][0] > boxes[j][1] + REACH_M) | (boxes[j][0] > boxes[i][1] + REACH_M)):
                continue
            into_j = _push(_within(samples[j], boxes[i]), casters[i]) - _push(_within(samples[i], boxes[j]), casters[j])
            pairs |= _carried(i, j, float(into_j[2]) / max(float(np.linalg.norm(into_j)), 1e-12))
    return frozenset(pairs)


def carried_by_pieces(solids: Sequence[Solids]) -> Pairs:
    """The same on convex pieces, which is what a simulation feels: the way between two pieces or out of one another.

    Args:
        solids: The pieces of each body as they stand in the table frame, z up.
    """
    pairs = set()
    for i in range(len(solids)):
        for j in range(i + 1, len(solids)):
            for up in _ways_up(solids[i], solids[j]):
                pairs |= _carried(i, j, up)
    return frozenset(pairs)


def _carried(i: int, j: int, up: float) -> set[tuple[int, int]]:
    """What a unit normal from i to j with this vertical part says."""
    return {(j, i)} if up >= UPWARD else {(i, j)} if up <= -UPWARD else set()


def _within(points: Points, box: tuple[Vector3, Vector3]) -> Points:
    """Those of the points that come within `REACH_M` of a box."""
    near: Points = points[((points >= box[0] - REACH_M) & (points <= box[1] + REACH_M)).all(axis=1)]
    return near


def _push(points: Points, caster: Caster) -> Vector3:
    """Sum of the outward normals of a surface where points come near it, the nearest weighing most."""
    if not len(points):
        return np.zeros(3)
    query = o3d.core.Tensor.from_numpy(points.astype(np.float32))
    found = caster.compute_closest_points(query, nthreads=1)
    way = points - found["points"].numpy().astype(np.float64)
    gap = np.linalg.norm(way, axis=1)
    normals = found["primitive_normals"].numpy().astype(np.float64)
    # On an edge either face may be the nearest: only one that looks along the way counts.
    along = np.einsum("ij,ij->i", way, normals)
    near = (gap <= REACH_M) & ((gap < TOUCHING_M) | (np.abs(along) > 0.8 * gap))
    total: Vector3 = (1.0 - gap[near] / REACH_M) @ normals[near]
    return total


def _ways_up(a: Solids, b: Solids) -> Iterator[float]:
    """Of each pair of pieces in contact, the vertical part of the unit normal from `a` to `b`."""
    return (float(result.normal[2]) for _, result in meetings(a, b, REACH_M))
