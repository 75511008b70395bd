"""The largest ball inside a closed surface that touches it in the middle of a face."""

import numpy as np
import open3d as o3d
from jaxtyping import Bool

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.boxes import box_around

SLACK = 1e-3
"""A ball is taken for one inside if the surface reaches into it by no more than this share of its radius."""
MOST_ROUNDS = 100
"""It takes five to ten."""

_RAYS = np.array([[0.8431, 0.4127, 0.3449], [-0.3178, 0.8052, -0.5006], [0.2903, -0.5618, 0.7747]])
"""Along no edge that anybody draws."""


def largest_ball(mesh: TriangleMesh, at_least: float, at_most: float) -> float:
    """Diameter of the largest ball inside a closed mesh that touches it in the middle of a face [m].

    Balls shrink (Ma, Bae and Choi 2012): each touches its face from inside and starts too large. The point of the
    surface nearest to its centre is put on the ball, until the centre is inside and no point in the ball.

    Args:
        mesh: Closed, its faces counter-clockwise seen from outside.
        at_least: Balls no larger are not looked for [m].
        at_most: No ball inside is larger [m].

    Returns:
        0 where all are at most `at_least`.
    """
    low, high = box_around(mesh.vertices)
    size = float((high - low).max())
    vertices = (mesh.vertices - (low + high) / 2) / size  # what follows is known to 1e-7 of the extent
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(c - a, b - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    face = np.flatnonzero(normals.any(axis=1))
    radii = np.full(len(face), at_most / 2 / size)
    scene = _scene(vertices, mesh)
    middles, found = (a + b + c) / 3, 0.0
    for _ in range(MOST_ROUNDS):
        large = radii > max(found, at_least / 2 / size)
        face, radii = face[large], radii[large]
        if not len(face):
            break
        centers = middles[face] + radii[:, None] * normals[face]
        nearest = _nearest(scene, centers)
        fits = np.linalg.norm(centers - nearest, axis=1) >= (1.0 - SLACK) * radii
        fits[fits] = _is_inside(scene, centers[fits])  # a centre may be beyond a film
        found = float(radii[fits].max(initial=found))
        chord = nearest - middles[face]
        ahead = np.einsum("ij,ij->i", chord, normals[face])
        through = np.einsum("ij,ij->i", chord, chord) / np.where(ahead > 0.0, 2.0 * ahead, np.inf)
        radii = np.where(fits, 0.0, np.minimum(through, (1.0 - SLACK / 2) * radii))
    return 2.0 * size * found


def _scene(vertices: Points, mesh: TriangleMesh) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    return scene


def _nearest(scene: o3d.t.geometry.RaycastingScene, points: Points) -> Points:
    """The points of a surface nearest to some."""
    query = o3d.core.Tensor.from_numpy(points.astype(np.float32))
    found: Points = scene.compute_closest_points(query, nthreads=1)["points"].numpy().astype(np.float64)
    return found


def _is_inside(scene: o3d.t.geometry.RaycastingScene, points: Points) -> Bool[np.ndarray, " n"]:
    """Whether points are inside a closed surface, as all rays from them say: one may pass between two faces."""
    inside = np.ones(len(points), dtype=bool)
    for direction in _RAYS:
        rays = np.concatenate([points, np.broadcast_to(direction, points.shape)], axis=1).astype(np.float32)
        crossed = scene.count_intersections(o3d.core.Tensor.from_numpy(rays), nthreads=1).numpy()
        inside &= crossed % 2 == 1
    return inside
