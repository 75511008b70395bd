"""The largest ball inside a closed surface that touches it in the middle of a face."""

import numpy as np
from jaxtyping import Bool, Float64

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene, pack_rays, to_tensor

TOLERANCE_SHARE = 1e-3  # share of its radius by which the surface may reach into a ball that counts as inside
MAX_ROUNDS = 100  # five to ten are usual
FIRST_BATCH = 64  # the largest balls are shrunk before the others
MIN_GAIN = 0.01  # balls larger than the best by no more than this share are not searched for
RAY_OFFSET = 1e-6  # how far inside rays begin, as a share of the extent: the face that they leave is not hit
# Skew: along no edge that is likely in a mesh.
_PROBE_DIRECTIONS = np.array([[0.8431, 0.4127, 0.3449], [-0.3178, 0.8052, -0.5006], [0.2903, -0.5618, 0.7747]])


def find_largest_ball(mesh: TriangleMesh, at_least: float, at_most: float) -> float:
    """Find the diameter of the largest ball inside a closed mesh that touches it in the middle of a face [m].

    Shrinking balls (Ma, Bae and Choi 2012): each touches its face from inside and starts too large. The surface point
    nearest to its centre is put on the ball, until the centre is inside and no point is in the ball. No ball inside is
    larger than `at_most` [m]; 0 where all are at most `at_least` [m].
    """
    low, high = aabb(mesh.vertices)
    size = float((high - low).max())
    vertices = (mesh.vertices - (low + high) / 2) / size  # what follows is known to 1e-7 of the extent
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(c - a, b - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    face = np.flatnonzero(normals.any(axis=1))
    caster = make_raycasting_scene(TriangleMesh(vertices, mesh.faces))
    middles, found = ((a + b + c) / 3)[face], at_least / 2 / size
    rays = pack_rays(middles + RAY_OFFSET * normals[face], normals[face])  # through the inside to the other side
    depths = caster.cast_rays(rays, nthreads=1)["t_hit"].numpy().astype(np.float64) + RAY_OFFSET
    radii = np.minimum(depths, at_most / size) / 2
    order = np.argsort(-radii, kind="stable")
    # The largest first: their result leaves few of the others. In a round object all centres begin near one point,
    # where every face is equally near and each query is slow.
    for some in (order[:FIRST_BATCH], order[FIRST_BATCH:]):
        found = _find_largest_radius(caster, middles[some], normals[face[some]], radii[some], found)
    return 2.0 * size * found if found > at_least / 2 / size else 0.0


def _find_largest_radius(
    caster: RaycastingScene, touched: Points, inward: Points, radii: Float64[np.ndarray, " n"], found: float
) -> float:
    """Find the largest radius of balls that touch a surface in points (n, 3), each at most its own, or `found`."""
    for _ in range(MAX_ROUNDS):
        large = radii > (1.0 + MIN_GAIN) * found
        touched, inward, radii = touched[large], inward[large], radii[large]
        if not len(radii):
            break
        centers = touched + radii[:, None] * inward
        closest = caster.compute_closest_points(to_tensor(centers), nthreads=1)["points"]
        nearest = closest.numpy().astype(np.float64)
        fits = np.linalg.norm(centers - nearest, axis=1) >= (1.0 - TOLERANCE_SHARE) * radii
        fits[fits] = _is_inside(caster, centers[fits])  # a centre may be beyond a film
        found = float(radii[fits].max(initial=found))
        chord = nearest - touched
        ahead = np.einsum("ij,ij->i", chord, inward)
        through = np.einsum("ij,ij->i", chord, chord) / np.where(ahead > 0.0, 2.0 * ahead, np.inf)
        radii = np.where(fits, 0.0, np.minimum(through, (1.0 - TOLERANCE_SHARE / 2) * radii))
    return found


def _is_inside(caster: RaycastingScene, points: Points) -> Bool[np.ndarray, " n"]:
    """Whether points are inside a closed surface; all rays must agree, as one may pass between two faces."""
    inside = np.ones(len(points), dtype=bool)
    for direction in _PROBE_DIRECTIONS:
        crossed = caster.count_intersections(pack_rays(points, direction), nthreads=1).numpy()
        inside &= crossed % 2 == 1
    return inside
