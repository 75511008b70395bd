"""Convex pieces standing in the table frame, ready for exact distance queries."""

from dataclasses import dataclass

import coal
import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import ConvexPieces, Points, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.transforms import transform_points


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """The pieces of one object (or of several), baked at a pose: a later motion is a translation alone.

    Attributes:
        shapes: One coal shape per piece, vertices in the table frame.
        points: The vertices of all pieces, one piece after the other. Shape (n, 3) [m].
        starts: Where each piece begins in `points`. Shape (k,).
        low: Lowest corner of each piece's box. Shape (k, 3) [m].
        high: Highest corner of each piece's box. Shape (k, 3) [m].
    """

    shapes: tuple[coal.Convex, ...]
    points: Points
    starts: Int64[np.ndarray, " k"]
    low: Float64[np.ndarray, "k 3"]
    high: Float64[np.ndarray, "k 3"]


def place_pieces(pieces: ConvexPieces, pose: Pose, scale: float) -> Solids:
    """The pieces of one object in the table frame: `R(q) @ (scale * vertex) + position`."""
    vertices = [transform_points(pose, hull.vertices, scale) for hull in pieces.hulls]
    shapes = tuple(convex_shape(points, hull) for points, hull in zip(vertices, pieces.hulls, strict=True))
    starts = np.cumsum([0, *(len(points) for points in vertices[:-1])])
    points = np.concatenate(vertices)
    low, high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    return Solids(shapes, points, starts, low, high)


def convex_shape(points: Points, hull: TriangleMesh) -> coal.Convex:
    """A coal shape of the hull's faces over `points`, which replace its vertices."""
    vertices = coal.StdVec_Vec3s()
    vertices.extend(list(points))
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(a, b, c) for a, b, c in hull.faces.tolist()])
    return coal.Convex(vertices, triangles)


def overlapping_boxes(
    a: Solids, b: Solids, margin: float = 0.0, offset: Vector3 | None = None
) -> list[tuple[int, int]]:
    """Pairs (piece of `a`, piece of `b`) whose boxes come within `margin` [m], with `a` moved by `offset` [m]."""
    shift = np.zeros(3) if offset is None else offset
    low, high = a.low + shift, a.high + shift
    apart = (low[:, None] > b.high[None] + margin) | (b.low[None] > high[:, None] + margin)
    return [(int(i), int(j)) for i, j in np.argwhere(~apart.any(axis=2))]
