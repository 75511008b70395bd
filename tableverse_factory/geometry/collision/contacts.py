"""Contacts between objects: on their convex pieces, and on the meshes that one sees."""

import numpy as np

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.collision.linear_sweep import MovingSolid
from tableverse_factory.geometry.collision.solids import find_near_pieces
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene, to_tensor

MAX_MESH_GAP_M = 0.004  # where pieces touch and a mesh is further away than this, the object looks as if it floats


def find_contact_points(a: MovingSolid, b: MovingSolid, reach_m: float) -> Points:
    """Find the points midway between pieces of two bodies that are within `reach_m` [m]. Shape (n, 3)."""
    found = [
        (result.getNearestPoint1() + result.getNearestPoint2()) / 2 + b.offset
        for _, result in find_near_pieces(a.solids, b.solids, reach_m, a.offset - b.offset)
    ]
    return np.array(found).reshape(-1, 3)


def measure_distances(surface: RaycastingScene, points: Points) -> np.ndarray:
    """Measure the distance of each point to a mesh [m]. Shape (n,)."""
    return surface.compute_distance(to_tensor(points), nthreads=1).numpy()


def meshes_touch(a: MovingSolid, mesh_a: TriangleMesh, b: MovingSolid, mesh_b: TriangleMesh, reach_m: float) -> bool:
    """Whether pieces come within `reach_m` [m] at a place where both meshes are, to within `MAX_MESH_GAP_M`.

    Pieces and meshes of both objects are in the same frame.
    """
    points = find_contact_points(a, b, reach_m)
    if len(points) == 0:
        return False
    apart = np.maximum(
        measure_distances(make_raycasting_scene(mesh_a), points),
        measure_distances(make_raycasting_scene(mesh_b), points),
    )
    return bool((apart <= MAX_MESH_GAP_M + reach_m).any())
