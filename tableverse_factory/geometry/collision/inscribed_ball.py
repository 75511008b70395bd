"""The largest ball inside a closed surface that touches it in the middle of a face."""

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float64

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.height_maps import Caster, column_caster

SLACK = 1e-3
"""A ball is taken for one inside if the surface reaches into it by no more than this share of its radius."""
MOST_ROUNDS = 100
"""It takes five to ten."""

FIRST = 64
"""So many of the largest are looked at before the others."""
WORTH = 0.01
"""A ball larger by no more than this share than one that was found is not looked for."""
OFF = 1e-6
"""Rays begin so far inside, as a share of the extent: the face that they leave is not hit."""

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
        0 where all are at most `at_least`; the largest found in `MOST_ROUNDS`, where that does not suffice.
    """
    low, high = aabb(mesh.vertices)
    size = float((high - low).max())
    vertices = (mesh.vertices - (low + high) / 2) / size  # what follows is known to 1e-7 of the extent
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(c - a, b - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    face = np.flatnonzero(normals.any(axis=1))
    caster = column_caster(TriangleMesh(vertices, mesh.faces))
    middles, found = ((a + b + c) / 3)[face], at_least / 2 / size
    radii = np.minimum(_depths(caster, middles, normals[face]), at_most / size) / 2
    order = np.argsort(-radii, kind="stable")
    # The largest alone first: what they find leaves few of the others to look for. All centres of a round thing begin
    # near one point, from which every face is as near as any other, and each such question takes long.
    for some in (order[:FIRST], order[FIRST:]):
        found = _largest_radius(caster, middles[some], normals[face[some]], radii[some], found)
    return 2.0 * size * found if found > at_least / 2 / size else 0.0


def _largest_radius(
    caster: Caster,
    touched: Points,
    inward: Points,
    radii: Float64[np.ndarray, " n"],
    found: float,
) -> float:
    """The largest radius of balls inside that touch a surface in some points; `found` where none is larger.

    Args:
        caster: Holds the surface.
        touched: The points. Shape (n, 3).
        inward: Unit normals there. Shape (n, 3).
        radii: What no ball there exceeds.
        found: Balls not worth more are not looked for.
    """
    for _ in range(MOST_ROUNDS):
        large = radii > (1.0 + WORTH) * found
        touched, inward, radii = touched[large], inward[large], radii[large]
        if not len(radii):
            break
        centers = touched + radii[:, None] * inward
        nearest = _nearest(caster, centers)
        fits = np.linalg.norm(centers - nearest, axis=1) >= (1.0 - SLACK) * radii
        fits[fits] = _is_inside(caster, centers[fits])  # a centre may be beyond a film
        found = float(radii[fits].max(initial=found))
        chord = nearest - touched
        ahead = np.einsum("ij,ij->i", chord, inward)
        through = np.einsum("ij,ij->i", chord, chord) / np.where(ahead > 0.0, 2.0 * ahead, np.inf)
        radii = np.where(fits, 0.0, np.minimum(through, (1.0 - SLACK / 2) * radii))
    return found


def _depths(caster: Caster, points: Points, inward: Points) -> Float64[np.ndarray, " n"]:
    """How far it is from points of a surface through the inside to the other side; infinity where nothing is hit."""
    rays = np.concatenate([points + OFF * inward, inward], axis=1).astype(np.float32)
    hits = caster.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)["t_hit"].numpy()
    depths: Float64[np.ndarray, " n"] = hits.astype(np.float64) + OFF
    return depths


def _nearest(caster: Caster, points: Points) -> Points:
    """The points of a surface nearest to some."""
    query = o3d.core.Tensor.from_numpy(points.astype(np.float32))
    found: Points = caster.compute_closest_points(query, nthreads=1)["points"].numpy().astype(np.float64)
    return found


def _is_inside(caster: Caster, points: Points) -> Bool[np.ndarray, " n"]:
    """Whether points are inside a closed surface, as all rays from them say: one may pass between two faces."""
    inside = np.ones(len(points), dtype=bool)
    for direction in _RAYS:
        rays = np.concatenate([points, np.broadcast_to(direction, points.shape)], axis=1).astype(np.float32)
        crossed = caster.count_intersections(o3d.core.Tensor.from_numpy(rays), nthreads=1).numpy()
        inside &= crossed % 2 == 1
    return inside
