"""How deep objects lie inside one another: on their convex pieces, and on their meshes."""

from collections.abc import Iterator, Sequence

import manifold3d
import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import ConvexPieces, Points, Pose, TriangleMesh
from tableverse_factory.geometry.collision.inscribed_ball import largest_ball
from tableverse_factory.geometry.collision.solids import Solids, meetings, place_pieces
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.geometry.mesh.repair import as_mesh, closed_solid

PairDepth = tuple[int, int, float]
"""Indices i < j of two objects and how deep they overlap [m], always > 0."""

FINE_M = 1e-4
"""What is nowhere thicker is not looked into: things at rest share micrometres with what carries them [m]."""


def piece_penetrations(
    pieces: Sequence[ConvexPieces], poses: Sequence[Pose], scales: Sequence[float]
) -> list[PairDepth]:
    """Every pair of objects whose convex pieces overlap.

    The depth of a pair is that of its deepest pair of pieces: the shortest translation that parts these two (EPA).
    """
    solids = [place_pieces(p, pose, scale) for p, pose, scale in zip(pieces, poses, scales, strict=True)]
    depths = ((i, j, _deepest(solids[i], solids[j])) for i, j in _index_pairs(len(solids)))
    return [(i, j, depth) for i, j, depth in depths if depth > 0.0]


def mesh_penetrations(
    meshes: Sequence[TriangleMesh], poses: Sequence[Pose], scales: Sequence[float]
) -> list[PairDepth]:
    """Every pair of objects whose meshes share volume, by exact Boolean intersection.

    The depth of a pair is that of its thickest connected region of shared volume (`region_thickness`).
    Meshes that are not closed are measured as `closed_solid` repairs them.

    Raises:
        GeometryError: if a mesh cannot be closed.
    """
    solids = [
        closed_solid(mesh)[0].transform(scale_and_pose(pose, scale))
        for mesh, pose, scale in zip(meshes, poses, scales, strict=True)
    ]
    boxes = [solid.bounding_box() for solid in solids]
    found = []
    for i, j in _index_pairs(len(solids)):
        if _boxes_meet(boxes[i], boxes[j]):
            regions = (solids[i] ^ solids[j]).decompose()
            depth = max((region_thickness(region) for region in regions), default=0.0)
            if depth > 0.0:
                found.append((i, j, depth))
    return found


def scale_and_pose(pose: Pose, scale: float) -> Float64[np.ndarray, "3 4"]:
    """The matrix `[scale R | position]` of the layout format."""
    return np.column_stack([scale * rotation_matrix(pose.quaternion_wxyz), pose.position])


def region_thickness(region: manifold3d.Manifold) -> float:
    """How thick a region of shared volume is [m]; at least a third of any ball in it that is found.

    The smaller of two bounds: its narrowest extent between parallel planes (along the normals of its convex hull),
    and 6 V / S, which no convex region's largest inscribed ball exceeds in diameter. A plate of thickness t gives t, a
    lens its height, a ball its diameter; a thin ring (two nested cups that graze) at most three times its thickness.
    Where the second is smaller, the region may be a film on something thick: a foot sunk into a table that the thing
    touches all around. The largest ball inside then says how thick it is, if it is larger.
    """
    volume, area = float(region.volume()), float(region.surface_area())
    if volume <= 0.0 or area <= 0.0:
        return 0.0
    mesh = as_mesh(region)
    mean, narrowest = 6.0 * volume / area, _narrowest_extent(mesh.vertices)
    if mean >= narrowest or narrowest <= FINE_M:
        return narrowest
    return max(mean, largest_ball(mesh, mean, narrowest))


def _narrowest_extent(points: Points) -> float:
    try:
        normals = ConvexHull(points - points.mean(axis=0)).equations[:, :3]
    except QhullError:  # flat to rounding: no thickness
        return 0.0
    return float(np.ptp(points @ normals.T, axis=0).min())


def _deepest(a: Solids, b: Solids) -> float:
    return max((-gap for gap, _ in meetings(a, b, 0.0)), default=0.0)


def _boxes_meet(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return all(a[k] < b[k + 3] and b[k] < a[k + 3] for k in range(3))


def _index_pairs(count: int) -> Iterator[tuple[int, int]]:
    return ((i, j) for i in range(count) for j in range(i + 1, count))
