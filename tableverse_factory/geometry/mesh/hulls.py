"""Convex hulls of point sets: their volume, and hulls of few vertices that keep nearly all of it."""

import manifold3d
import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points, TriangleMesh

VERTICES_PER_ROUND = 6
SLIVER = 1e-9
"""A triangle less high than this share of its length has no direction that could be believed."""
SHARPEST = 0.5
"""Cosine between the direction of a corner and its faces' normals."""


def fibonacci_directions(count: int) -> Points:
    """Unit vectors spread evenly over the sphere. Shape (count, 3)."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


_SUPPORTS = fibonacci_directions(96)


def cross(a: Points, b: Points) -> Points:
    """Cross products of rows, the same as numpy's, which spends more time on other shapes than on few rows."""
    product = np.empty_like(a)
    product[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    product[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    product[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return product


def hull_of(points: Points) -> manifold3d.Manifold:
    """The convex hull as a solid, quickly; empty where the points are coplanar.

    In one of twenty thin shapes it has slivers that are not convex, in one of two hundred it lacks a corner: good
    enough to weigh volumes and to unite, not to build on (`hull_mesh`).
    """
    return manifold3d.Manifold.hull_points(np.array(points, dtype=np.float64, order="C"))


def hull_volume(points: Points) -> float:
    """Volume of the convex hull; 0 where it is flat."""
    return float(hull_of(points).volume()) if len(points) > 3 else 0.0


def extreme_points(points: Points) -> Points:
    """Those points that lie furthest in some of 96 directions: their hull stands for that of all."""
    if len(points) <= len(_SUPPORTS):
        return points
    along = np.ascontiguousarray((points @ _SUPPORTS.T).T)
    extreme: Points = points[np.unique(np.argmax(along, axis=1))]
    return extreme


def bounded_hull(points: Points, max_vertices: int, tolerance: float) -> TriangleMesh:
    """A hull of at most `max_vertices` that covers the points, or nearly.

    It grows from a simplex: each round adds, face by face, the point furthest outside, until none lies further out than
    `tolerance` or there are enough. What is still outside then is covered by moving the corners outward.

    Raises:
        ValueError: if the points span no volume.
    """
    corners = hull_mesh(points).vertices
    chosen = _simplex(corners)
    hull = hull_mesh(corners[chosen])
    while len(chosen) < max_vertices:
        heights, face = protrusion(hull, corners)
        by_height = np.argsort(-heights, kind="stable")
        first_of_face = np.unique(face[by_height], return_index=True)[1]
        furthest = by_height[np.sort(first_of_face)][: min(max_vertices - len(chosen), VERTICES_PER_ROUND)]
        worst = [int(i) for i in furthest if heights[i] > tolerance]
        if not worst:
            break
        chosen.extend(worst)
        hull = hull_mesh(corners[chosen])
    return _raised(hull, corners) if len(chosen) < len(corners) else hull


def _raised(hull: TriangleMesh, points: Points) -> TriangleMesh:
    """The hull with its corners moved out so far that each face clears the points above it.

    A corner sharper than `SHARPEST` moves less than that would take: it would become a thorn.
    """
    heights, face = protrusion(hull, points)
    lift = np.zeros(len(hull.faces))
    np.maximum.at(lift, face, np.maximum(heights, 0.0))
    normals = face_normals(hull)
    moved = hull.vertices.copy()
    for corner in range(len(moved)):
        mine = (hull.faces == corner).any(axis=1)
        out = normals[mine].sum(axis=0)
        out /= max(float(np.linalg.norm(out)), 1e-12)
        moved[corner] += out * float((lift[mine] / np.maximum(normals[mine] @ out, SHARPEST)).max())
    return hull_mesh(moved)


def hull_mesh(points: Points) -> TriangleMesh:
    """The convex hull as triangles, counter-clockwise seen from outside.

    Raises:
        ValueError: if the points span no volume.
    """
    try:
        return TriangleMesh(*outward_faces(ConvexHull(points)))
    except QhullError as error:
        raise ValueError(f"{len(points)} points span no volume") from error


def outward_faces(hull: ConvexHull) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and counter-clockwise triangles of a scipy hull, only the vertices that it uses, in their order."""
    used = np.zeros(len(hull.points), dtype=bool)
    used[hull.simplices] = True
    keep = np.flatnonzero(used)
    place = np.full(len(hull.points), -1, dtype=np.int32)
    place[keep] = np.arange(len(keep), dtype=np.int32)
    corners = hull.points[hull.simplices]
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces = place[hull.simplices]
    faces[inward] = faces[inward][:, ::-1]
    return hull.points[keep].copy(), np.ascontiguousarray(faces)


def _simplex(points: Points) -> list[int]:
    """Four of the points that span a volume: two ends, the furthest from their line, the furthest from the plane."""
    a = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    b = int(np.argmax(np.linalg.norm(points - points[a], axis=1)))
    c = int(np.argmax(np.linalg.norm(np.cross(points - points[a], points[b] - points[a]), axis=1)))
    heights = np.abs((points - points[a]) @ np.cross(points[b] - points[a], points[c] - points[a]))
    d = int(np.argmax(heights))
    if heights[d] <= 0.0:
        raise ValueError(f"{len(points)} points span no volume")
    return [a, b, c, d]


def face_normals(hull: TriangleMesh) -> Points:
    """Unit outward normals of the faces; zero for slivers, which then bound nothing."""
    a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
    normals = cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    longest = np.max([np.einsum("ij,ij->i", side, side) for side in (b - a, c - b, a - c)], axis=0)
    unit: Points = normals * (doubled > SLIVER * longest)[:, None] / np.maximum(doubled, 1e-300)[:, None]
    return unit


def face_heights(hull: TriangleMesh, points: Points) -> Float64[np.ndarray, "n m"]:
    """How far each point lies above the plane of each face, negative below."""
    normals = face_normals(hull)
    heights: Float64[np.ndarray, "n m"] = points @ normals.T
    heights -= np.einsum("ij,ij->i", normals, hull.vertices[hull.faces[:, 0]])
    return heights


def protrusion(hull: TriangleMesh, points: Points) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """How far each point lies outside the hull's planes, at most (negative inside), and of which face."""
    heights = face_heights(hull, points)
    face = np.argmax(heights, axis=1)
    return np.take_along_axis(heights, face[:, None], axis=1)[:, 0], face
