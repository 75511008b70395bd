"""Penetration depth of objects: on their convex pieces, and on their meshes."""

from collections.abc import Sequence
from itertools import combinations

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from tableverse_factory.geometry.collision.inscribed_ball import find_largest_ball
from tableverse_factory.geometry.collision.solids import find_near_pieces, place_pieces
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.geometry.mesh.repair import make_closed_solid, solid_to_mesh

PairDepth = tuple[int, int, float]  # indices i < j of two objects and how deep they overlap [m], always > 0

THIN_M = 1e-4  # thinner overlaps are not examined further: objects at rest share micrometres with what carries them


def measure_piece_penetrations(
    pieces: Sequence[ConvexPieces], poses: Sequence[Pose], scales: Sequence[float]
) -> list[PairDepth]:
    """Measure every pair of objects whose convex pieces overlap, by the depth of its deepest pair of pieces (EPA)."""
    solids = [place_pieces(p, pose, scale) for p, pose, scale in zip(pieces, poses, scales, strict=True)]
    found = []
    for i, j in combinations(range(len(solids)), 2):
        depth = max((-gap for gap, _ in find_near_pieces(solids[i], solids[j], 0.0)), default=0.0)
        if depth > 0.0:
            found.append((i, j, depth))
    return found


def measure_mesh_penetrations(
    meshes: Sequence[TriangleMesh], poses: Sequence[Pose], scales: Sequence[float]
) -> list[PairDepth]:
    """Measure every pair of objects whose meshes share volume, by exact Boolean intersection.

    The depth of a pair is that of its thickest connected region of shared volume (`measure_thickness`).
    Meshes that are not closed are measured as `make_closed_solid` repairs them.
    """
    solids = [
        make_closed_solid(mesh)[0].transform(
            np.column_stack([scale * rotation_matrix(pose.quaternion_wxyz), pose.position])
        )
        for mesh, pose, scale in zip(meshes, poses, scales, strict=True)
    ]
    boxes = [solid.bounding_box() for solid in solids]
    found = []
    for i, j in combinations(range(len(solids)), 2):
        a, b = boxes[i], boxes[j]
        if all(a[k] < b[k + 3] and b[k] < a[k + 3] for k in range(3)):
            regions = (solids[i] ^ solids[j]).decompose()
            depth = max((measure_thickness(region) for region in regions), default=0.0)
            if depth > 0.0:
                found.append((i, j, depth))
    return found


def measure_thickness(region: manifold3d.Manifold) -> float:
    """Measure how thick a region of shared volume is [m]; at least a third of any ball found in it.

    The smaller of two bounds: its narrowest extent between parallel planes (along the normals of its convex hull),
    and 6 V / S, which the largest ball inscribed in a convex region does not exceed in diameter. A plate of thickness t
    gives t, a lens its height, a ball its diameter; a thin ring (two nested cups that graze) at most three times its
    thickness. Where the second is smaller, the region may be a film on something thick, such as a foot sunk into a
    table that is touched all around: then the largest ball inside decides, if it is larger.
    """
    volume, area = float(region.volume()), float(region.surface_area())
    if volume <= 0.0 or area <= 0.0:
        return 0.0
    mesh = solid_to_mesh(region)
    try:
        normals = ConvexHull(mesh.vertices - mesh.vertices.mean(axis=0)).equations[:, :3]
    except QhullError:  # flat to rounding: no thickness
        return 0.0
    mean, narrowest = 6.0 * volume / area, float(np.ptp(mesh.vertices @ normals.T, axis=0).min())
    if mean >= narrowest or narrowest <= THIN_M:
        return narrowest
    return max(mean, find_largest_ball(mesh, mean, narrowest))
