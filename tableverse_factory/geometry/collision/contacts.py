"""Whether two things that touch on their convex pieces are also seen to touch, on their meshes."""

import numpy as np
import open3d as o3d

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.collision.ray_clearance import MovingSolid
from tableverse_factory.geometry.collision.solids import meetings
from tableverse_factory.geometry.mesh.height_maps import Caster, column_caster

SEEN_APART_M = 0.004
"""Where pieces touch and a mesh is further away than this, one sees a thing that floats."""


def contact_points(a: MovingSolid, b: MovingSolid, reach_m: float) -> Points:
    """Points midway between pieces of one body and pieces of the other that are within `reach_m` [m]. Shape (n, 3)."""
    found = [
        (result.getNearestPoint1() + result.getNearestPoint2()) / 2 + b.offset
        for _, result in meetings(a.solids, b.solids, reach_m, a.offset - b.offset)
    ]
    return np.array(found).reshape(-1, 3)


def distances_to(surface: Caster, points: Points) -> np.ndarray:
    """Distance of each point to a mesh [m]. Shape (n,)."""
    tensor = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
    distances: np.ndarray = surface.compute_distance(tensor, nthreads=1).numpy()
    return distances


def seen_to_touch(a: MovingSolid, mesh_a: TriangleMesh, b: MovingSolid, mesh_b: TriangleMesh, reach_m: float) -> bool:
    """Whether the pieces come within `reach_m` somewhere where both meshes are, to within `SEEN_APART_M`.

    Args:
        a: The pieces of one thing.
        mesh_a: Its mesh, same frame.
        b: The pieces of the other.
        mesh_b: Its mesh, same frame.
        reach_m: Gap between pieces that counts as touching [m].
    """
    points = contact_points(a, b, reach_m)
    if len(points) == 0:
        return False
    apart = np.maximum(distances_to(column_caster(mesh_a), points), distances_to(column_caster(mesh_b), points))
    return bool((apart <= SEEN_APART_M + reach_m).any())
