"""Planes in point sets (least squares, seeded RANSAC); convex outlines and least rectangles in a plane."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Frozen, Points, Vector3
from tableverse_factory.core.errors import GeometryError

Points2 = Float64[np.ndarray, "n 2"]
PerPoint = Float64[np.ndarray, " n"]
Selection = Bool[np.ndarray, " n"]

HYPOTHESES = 400
REFINED_HYPOTHESES = 12
REFINEMENTS = 3
_HYPOTHESES_PER_BLOCK = 100
_POINTS_PER_BLOCK = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Plane(Frozen):
    """The points `x` with `normal · x = offset` [m]; the normal has unit length."""

    normal: Vector3
    offset: float

    def heights(self, points: Float64[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape"]:
        """Signed distances along the normal [m]."""
        return points @ self.normal - self.offset

    def facing(self, viewpoint: Vector3) -> "Plane":
        """The same plane, its normal on the viewpoint's side."""
        return self if float(self.heights(viewpoint)) >= 0.0 else Plane(-self.normal, -self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class Rectangle(Frozen):
    """A rectangle in a plane [m], its own axes rotated by `yaw`, in [-pi/4, pi/4) [rad]."""

    center: Float64[np.ndarray, "2"]
    half_size: Float64[np.ndarray, "2"]
    yaw: float

    def distance(self, point: Float64[np.ndarray, "2"]) -> float:
        """Distance of a point outside [m]; 0 within."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        offset = np.array([[cos, sin], [-sin, cos]]) @ (point - self.center)
        return float(np.linalg.norm(np.maximum(np.abs(offset) - self.half_size, 0.0)))


def fit_plane(points: Points) -> Plane:
    """Fit a plane by total least squares."""
    if len(points) < 3:
        raise ValueError(f"{len(points)} points span no plane: give at least 3")
    center = points.mean(axis=0)
    offsets = points - center
    _, vectors = np.linalg.eigh(offsets.T @ offsets)
    normal = vectors[:, 0]
    return Plane(normal, float(normal @ center))


def refine_plane(plane: Plane, points: Points, tolerance: PerPoint) -> Plane:
    """Refit a plane to its inliers a few times; unchanged where fewer than three are left."""
    for _ in range(REFINEMENTS):
        inliers = np.abs(plane.heights(points)) <= tolerance
        if int(inliers.sum()) < 3:
            return plane
        plane = fit_plane(points[inliers])
    return plane


def fit_shared_normal(patches: Sequence[Points]) -> Vector3:
    """Fit the common normal, of arbitrary sign, of parallel planes of (weighted) points by total least squares."""
    if sum(len(points) for points in patches) < 3:
        raise ValueError("fewer than 3 points span no plane")
    offsets = np.vstack([points - points.mean(axis=0) for points in patches if len(points)])
    _, vectors = np.linalg.eigh(offsets.T @ offsets)
    return vectors[:, 0]


def find_dominant_planes(
    points: Points, tolerance: PerPoint, rng: np.random.Generator, max_planes: int, min_inliers: int
) -> Iterator[tuple[Plane, Selection]]:
    """Find planes in order of their inliers, each by RANSAC in the points that the ones before it left over.

    Yields each refined plane with its inliers, points within `tolerance` (n,) [m], until the best has too few.
    Neighbours in space must be near one another in the order of the points (n, 3) [m], as in rows of an image: the
    three points of a hypothesis are drawn close together, so that small planes are hit as well.
    """
    left = np.ones(len(points), dtype=bool)
    for _ in range(max_planes):
        index = np.flatnonzero(left)
        if len(index) < max(min_inliers, 3):
            return
        plane = _find_best_plane(points[index], tolerance[index], rng)
        inliers = left & (np.abs(plane.heights(points)) <= tolerance)
        if int(inliers.sum()) < max(min_inliers, 3):
            return
        yield plane, inliers
        left &= ~inliers


def _find_best_plane(points: Points, tolerance: PerPoint, rng: np.random.Generator) -> Plane:
    normals, offsets = _draw_hypotheses(points, rng)
    blocks = [slice(k, k + _HYPOTHESES_PER_BLOCK) for k in range(0, len(normals), _HYPOTHESES_PER_BLOCK)]
    counts = np.concatenate(
        [(np.abs(points @ normals[some].T - offsets[some]) <= tolerance[:, None]).sum(axis=0) for some in blocks]
    )
    best, best_count = Plane(normals[0], float(offsets[0])), -1
    for k in np.argsort(-counts, kind="stable")[:REFINED_HYPOTHESES]:
        plane = refine_plane(Plane(normals[k], float(offsets[k])), points, tolerance)
        count = int((np.abs(plane.heights(points)) <= tolerance).sum())
        if count > best_count:
            best, best_count = plane, count
    return best


def _draw_hypotheses(
    points: Points, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, " k"]]:
    """Draw planes through three points: half of the triples from anywhere, half from a stretch of the order."""
    n = len(points)
    first = rng.integers(0, n, HYPOTHESES)
    reach = np.where(np.arange(HYPOTHESES) % 2 == 0, n, max(n // 10, 3))
    others = (first[:, None] + (rng.random((HYPOTHESES, 2)) * reach[:, None]).astype(np.int64)) % n
    a, b, c = points[first], points[others[:, 0]], points[others[:, 1]]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = np.where(lengths[:, None] > 1e-9, normals / np.maximum(lengths, 1e-9)[:, None], [0.0, 0.0, 1.0])
    return normals, np.einsum("ij,ij->i", normals, a)


def compute_convex_outline(points_xy: Points2, margin: float = 1e-3) -> Points2:
    """Compute the convex hull, counter-clockwise; of points on a line the box, wider by `margin` [m]. Shape (m, 2)."""
    try:
        return np.asarray(points_xy[ConvexHull(points_xy).vertices], dtype=np.float64)
    except (QhullError, ValueError):
        low, high = points_xy.min(axis=0) - margin, points_xy.max(axis=0) + margin
        return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def measure_depth_inside(outline: Points2, points_xy: Float64[np.ndarray, "*shape 2"]) -> Float64[np.ndarray, "*shape"]:
    """Measure how far each point lies inside a convex counter-clockwise outline, negative outside [m].

    Outside, near a corner, the distance is that to the nearer edge's line.
    """
    edges = np.roll(outline, -1, axis=0) - outline
    inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.maximum(np.hypot(*edges.T), 1e-12)[:, None]
    offsets = np.einsum("ij,ij->i", inward, outline)
    flat = points_xy.reshape(-1, 2)
    depths = np.full(len(flat), np.inf)
    for k in range(0, len(flat), _POINTS_PER_BLOCK):  # blocks that stay in the processor's cache
        x, y = np.ascontiguousarray(flat[k : k + _POINTS_PER_BLOCK].T)
        block = depths[k : k + _POINTS_PER_BLOCK]
        for (a, b), offset in zip(inward, offsets, strict=True):
            np.minimum(block, a * x + b * y - offset, out=block)
    return depths.reshape(points_xy.shape[:-1])


def is_inside_outline(
    outline: Points2, points_xy: Float64[np.ndarray, "*shape 2"], margin: float = 0.0
) -> Bool[np.ndarray, "*shape"]:
    """Whether each point lies in a convex counter-clockwise outline, or within `margin` of its edges [m]."""
    return measure_depth_inside(outline, points_xy) >= -margin


def fit_min_rectangle(points: Points2) -> Rectangle:
    """Fit the rectangle of least area around all points (one of its sides lies on an edge of their hull).

    Raises:
        GeometryError: if the points lie on a line.
    """
    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise GeometryError(f"{len(points)} points span no area") from error
    edges = np.roll(hull, -1, axis=0) - hull
    angles = np.mod(np.arctan2(edges[:, 1], edges[:, 0]) + np.pi / 4, np.pi / 2) - np.pi / 4
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    along = hull @ axes.T
    across = hull @ np.stack([-axes[:, 1], axes[:, 0]], axis=0)
    best = int(np.argmin(np.ptp(along, axis=0) * np.ptp(across, axis=0)))
    low = np.array([along[:, best].min(), across[:, best].min()])
    high = np.array([along[:, best].max(), across[:, best].max()])
    u, v = axes[best], np.array([-axes[best, 1], axes[best, 0]])
    middle = (low + high) / 2
    return Rectangle(middle[0] * u + middle[1] * v, (high - low) / 2, float(angles[best]))
