"""Convex pieces standing in the table frame, ready for exact distance queries."""

from dataclasses import dataclass

import coal
import numpy as np
from jaxtyping import Float64

from schemas.geometry import ConvexPieces, Points, Pose, TriangleMesh
from tableverse_factory.geometry.transforms import transform_points


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """The pieces of one object (or of several), baked at a pose: a later motion is a translation alone.

    Attributes:
        shapes: One coal shape per piece, vertices in the table frame.
        vertices: The same vertices. Each of shape (n, 3) [m].
        low: Lowest corner of each piece's box. Shape (k, 3) [m].
        high: Highest corner of each piece's box. Shape (k, 3) [m].
    """

    shapes: tuple[coal.Convex, ...]
    vertices: tuple[Points, ...]
    low: Float64[np.ndarray, "k 3"]
    high: Float64[np.ndarray, "k 3"]


def place_pieces(pieces: ConvexPieces, pose: Pose, scale: float) -> Solids:
    """The pieces of one object in the table frame: `R(q) @ (scale * vertex) + position`."""
    vertices = tuple(transform_points(pose, hull.vertices, scale) for hull in pieces.hulls)
    shapes = tuple(convex_shape(points, hull) for points, hull in zip(vertices, pieces.hulls, strict=True))
    return Solids(
        shapes,
        vertices,
        np.array([points.min(axis=0) for points in vertices]),
        np.array([points.max(axis=0) for points in vertices]),
    )


def convex_shape(points: Points, hull: TriangleMesh) -> coal.Convex:
    """A coal shape of the hull's faces over `points`, which replace its vertices."""
    vertices = coal.StdVec_Vec3s()
    vertices.extend(list(points))
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(a, b, c) for a, b, c in hull.faces.tolist()])
    return coal.Convex(vertices, triangles)


def overlapping_boxes(a: Solids, b: Solids, margin: float = 0.0) -> list[tuple[int, int]]:
    """Pairs (piece of `a`, piece of `b`) whose boxes come within `margin` [m] of each other, in order."""
    apart = (a.low[:, None] > b.high[None] + margin) | (b.low[None] > a.high[:, None] + margin)
    return [(int(i), int(j)) for i, j in np.argwhere(~apart.any(axis=2))]
