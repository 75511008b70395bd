"""Contacts on meshes and on convex pieces, and supports: those whose normals point mostly upwards."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from schemas.geometry import Points, TriangleMesh, Vector3
from tableverse_factory.geometry.collision.linear_sweep import MovingSolid
from tableverse_factory.geometry.collision.solids import Solids, find_near_pieces
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene, to_tensor
from tableverse_factory.geometry.mesh.surface_samples import sample_surface

Pairs = frozenset[tuple[int, int]]  # (carried, carrier), indices of bodies

REACH_M = 0.002  # surfaces this near touch: a layout that was never simulated keeps gaps of this order
UPWARD = 0.5  # least vertical part of a supporting contact's unit normal: 30° above the horizontal; others only lean
SAMPLES = 4000  # points on each surface: 1 to 3 mm apart on household objects
TOUCHING_M = 0.0002  # nearer surfaces have no meaningful direction between them; their normals decide alone
MAX_MESH_GAP_M = 0.004  # where pieces touch and a mesh is further away than this, the object looks as if it floats


def meshes_touch(a: MovingSolid, mesh_a: TriangleMesh, b: MovingSolid, mesh_b: TriangleMesh, reach_m: float) -> bool:
    """Whether pieces come within `reach_m` [m] where both meshes, in the same frame, are within `MAX_MESH_GAP_M`."""
    near = find_near_pieces(a.solids, b.solids, reach_m, a.offset - b.offset)
    midway = [(result.getNearestPoint1() + result.getNearestPoint2()) / 2 + b.offset for _, result in near]
    if not midway:
        return False
    points = to_tensor(np.array(midway))
    apart = [make_raycasting_scene(mesh).compute_distance(points, nthreads=1).numpy() for mesh in (mesh_a, mesh_b)]
    return bool((np.maximum(*apart) <= MAX_MESH_GAP_M + reach_m).any())


def find_mesh_support(meshes: Sequence[TriangleMesh]) -> Pairs:
    """Find pairs of meshes in the table frame that touch, the contact's normal pointing up from one into the other.

    The normal is the mean over all points of either surface within `REACH_M` of the other, the nearest counting most.
    """
    boxes = [aabb(mesh.vertices) for mesh in meshes]
    samples = [sample_surface(mesh, SAMPLES)[0] for mesh in meshes]
    casters = [make_raycasting_scene(mesh) for mesh in meshes]
    pairs = set()
    for i, j in combinations(range(len(meshes)), 2):
        if any((boxes[i][0] > boxes[j][1] + REACH_M) | (boxes[j][0] > boxes[i][1] + REACH_M)):
            continue
        out_of_i = _sum_contact_normals(_select_near_box(samples[j], boxes[i]), casters[i])
        out_of_j = _sum_contact_normals(_select_near_box(samples[i], boxes[j]), casters[j])
        normal = out_of_i - out_of_j
        pairs |= _classify_pair(i, j, float(normal[2]) / max(float(np.linalg.norm(normal)), 1e-12))
    return frozenset(pairs)


def find_piece_support(solids: Sequence[Solids]) -> Pairs:
    """Find supports on convex pieces in the table frame, which is what a simulation feels."""
    pairs = set()
    for i, j in combinations(range(len(solids)), 2):
        for _, result in find_near_pieces(solids[i], solids[j], REACH_M):
            pairs |= _classify_pair(i, j, float(result.normal[2]))
    return frozenset(pairs)


def _classify_pair(i: int, j: int, up: float) -> set[tuple[int, int]]:
    """The (carried, carrier) pair that a unit normal from i to j with this vertical part implies, if any."""
    return {(j, i)} if up >= UPWARD else {(i, j)} if up <= -UPWARD else set()


def _select_near_box(points: Points, box: tuple[Vector3, Vector3]) -> Points:
    return points[((points >= box[0] - REACH_M) & (points <= box[1] + REACH_M)).all(axis=1)]


def _sum_contact_normals(points: Points, caster: RaycastingScene) -> Vector3:
    if not len(points):
        return np.zeros(3)
    found = caster.compute_closest_points(to_tensor(points), nthreads=1)
    way = points - found["points"].numpy().astype(np.float64)
    gap = np.linalg.norm(way, axis=1)
    normals = found["primitive_normals"].numpy().astype(np.float64)
    # On an edge either face may be the nearest: only one that looks along the way counts.
    along = np.einsum("ij,ij->i", way, normals)
    near = (gap <= REACH_M) & ((gap < TOUCHING_M) | (np.abs(along) > 0.8 * gap))
    return (1.0 - gap[near] / REACH_M) @ normals[near]
