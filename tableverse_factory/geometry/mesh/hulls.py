"""Convex hulls of point sets: their volume, and hulls of few vertices that keep nearly all of it."""

from collections.abc import Iterable

import manifold3d
import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.manifold_threads import limit_manifold_threads

limit_manifold_threads()

VERTICES_PER_ROUND = 6
SLIVER = 1e-9  # a triangle lower than this share of its length has no reliable normal
MIN_CORNER_COSINE = 0.5  # cosine between the direction of a corner and its faces' normals


def fibonacci_directions(count: int) -> Points:
    """Spread unit vectors evenly over the sphere. Shape (count, 3)."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


_SUPPORTS = fibonacci_directions(96)


def cross_rows(a: Points, b: Points) -> Points:
    """Cross products of rows, bit for bit those of numpy, which is slower for few rows."""
    product = np.empty_like(a)
    product[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    product[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    product[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return product


def make_hull(points: Points) -> manifold3d.Manifold:
    """Make the convex hull as a solid, quickly; empty where the points are coplanar.

    One in twenty thin shapes has slivers that are not convex, one in two hundred lacks a corner: good enough for
    volumes and unions; use `make_hull_mesh` otherwise.
    """
    return manifold3d.Manifold.hull_points(np.array(points, dtype=np.float64, order="C"))


def unite_hulls(pieces: Iterable[TriangleMesh]) -> manifold3d.Manifold:
    """Unite the convex hulls of pieces."""
    return manifold3d.Manifold.batch_boolean([make_hull(piece.vertices) for piece in pieces], manifold3d.OpType.Add)


def compute_hull_volume(points: Points) -> float:
    """Compute the volume of the convex hull; 0 where it is flat."""
    return float(make_hull(points).volume()) if len(points) > 3 else 0.0


def find_extreme_points(points: Points) -> Points:
    """Find the points that lie furthest in some of 96 directions: their hull approximates that of all."""
    if len(points) <= len(_SUPPORTS):
        return points
    return points[np.unique(np.argmax(_SUPPORTS @ points.T, axis=1))]


def make_bounded_hull(points: Points, max_vertices: int, tolerance: float) -> TriangleMesh:
    """Make a hull of at most `max_vertices` that covers the points, or nearly."""
    return reduce_hull(make_hull_mesh(points).vertices, max_vertices, tolerance)


def reduce_hull(corners: Points, max_vertices: int, tolerance: float) -> TriangleMesh:
    """Make a hull of at most `max_vertices` that covers the corners of a convex hull, or nearly.

    It grows from a simplex: each round adds, face by face, the corner furthest outside, until none lies further out
    than `tolerance` or there are enough. Those still outside are then covered by moving the chosen ones outward.
    """
    chosen = _find_simplex(corners)
    hull = make_hull_mesh(corners[chosen])
    while len(chosen) < max_vertices:
        heights, face = measure_protrusion(hull, corners)
        by_height = np.argsort(-heights, kind="stable")
        first_of_face = np.unique(face[by_height], return_index=True)[1]
        furthest = by_height[np.sort(first_of_face)][: min(max_vertices - len(chosen), VERTICES_PER_ROUND)]
        worst = [int(i) for i in furthest if heights[i] > tolerance]
        if not worst:
            break
        chosen.extend(worst)
        hull = make_hull_mesh(corners[chosen])
    return _expand_hull(hull, corners) if len(chosen) < len(corners) else hull


def _expand_hull(hull: TriangleMesh, points: Points) -> TriangleMesh:
    """Move the corners of a hull out until each face clears the points above it.

    A corner sharper than `MIN_CORNER_COSINE` moves less than that would take: it would become a thorn.
    """
    heights, face = measure_protrusion(hull, points)
    lift = np.zeros(len(hull.faces))
    np.maximum.at(lift, face, np.maximum(heights, 0.0))
    order = np.argsort(hull.faces.ravel(), kind="stable")
    corner, face_of = hull.faces.ravel()[order], order // 3
    normals = compute_face_normals(hull)[face_of]
    out = np.zeros_like(hull.vertices)
    np.add.at(out, corner, normals)
    out /= np.maximum(np.sqrt([way.dot(way) for way in out]), 1e-12)[:, None]
    starts = np.searchsorted(corner, np.arange(len(out)))
    around = zip(starts.tolist(), [*starts[1:].tolist(), len(corner)], out, strict=True)
    cosine = np.concatenate([normals[start:end] @ way for start, end, way in around])
    way_out = np.maximum.reduceat(lift[face_of] / np.maximum(cosine, MIN_CORNER_COSINE), starts)
    return make_hull_mesh(hull.vertices + out * way_out[:, None])


def make_hull_mesh(points: Points) -> TriangleMesh:
    """Make the convex hull as triangles, counter-clockwise seen from outside; flat points are a `GeometryError`."""
    try:
        return TriangleMesh(*_orient_faces_outward(ConvexHull(points)))
    except QhullError as error:
        raise GeometryError(f"{len(points)} points span no volume") from error


def _orient_faces_outward(hull: ConvexHull) -> tuple[np.ndarray, np.ndarray]:
    """Convert a scipy hull to its used vertices, in their order, and counter-clockwise triangles."""
    used = np.zeros(len(hull.points), dtype=bool)
    used[hull.simplices] = True
    keep = np.flatnonzero(used)
    place = np.full(len(hull.points), -1, dtype=np.int32)
    place[keep] = np.arange(len(keep), dtype=np.int32)
    corners = hull.points[hull.simplices]
    normals = cross_rows(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces = place[hull.simplices]
    faces[inward] = faces[inward][:, ::-1]
    return hull.points[keep].copy(), np.ascontiguousarray(faces)


def _find_simplex(points: Points) -> list[int]:
    """Find four points that span a volume: two ends, the furthest from their line, the furthest from the plane."""
    a = int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))
    b = int(np.argmax(np.linalg.norm(points - points[a], axis=1)))
    c = int(np.argmax(np.linalg.norm(np.cross(points - points[a], points[b] - points[a]), axis=1)))
    heights = np.abs((points - points[a]) @ np.cross(points[b] - points[a], points[c] - points[a]))
    d = int(np.argmax(heights))
    if heights[d] <= 0.0:
        raise GeometryError(f"{len(points)} points span no volume")
    return [a, b, c, d]


def compute_face_normals(hull: TriangleMesh) -> Points:
    """Compute unit outward normals of the faces; zero for slivers, which then bound nothing."""
    a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
    normals = cross_rows(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    longest = np.max([np.einsum("ij,ij->i", side, side) for side in (b - a, c - b, a - c)], axis=0)
    return normals * (doubled > SLIVER * longest)[:, None] / np.maximum(doubled, 1e-300)[:, None]


def compute_face_heights(hull: TriangleMesh, points: Points) -> Float64[np.ndarray, "n m"]:
    """Compute how far each point lies above the plane of each face, negative below."""
    normals = compute_face_normals(hull)
    heights: Float64[np.ndarray, "n m"] = points @ normals.T
    heights -= np.einsum("ij,ij->i", normals, hull.vertices[hull.faces[:, 0]])
    return heights


def measure_protrusion(hull: TriangleMesh, points: Points) -> tuple[Float64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Measure how far each point lies outside the hull's planes, at most (negative inside), and of which face."""
    heights = compute_face_heights(hull, points)
    face = np.argmax(heights, axis=1)
    return np.take_along_axis(heights, face[:, None], axis=1)[:, 0], face
