"""Convex pieces in the table frame, for exact distance queries."""

from collections.abc import Iterator, Sequence

import coal
import numpy as np

from schemas.geometry import ConvexPieces, Faces, Matrix3, Points, Pose, Vector3
from tableverse_factory.geometry.math.transforms import transform_points


class Solids:
    """The pieces of one object in the table frame.

    Attributes:
        points: The vertices of all pieces in the table frame, one piece after the other. Shape (n, 3) [m].
        starts: Where each piece begins in `points`. Shape (k,).
        low: Lowest corner of each piece's box. Shape (k, 3) [m].
        high: Highest corner of each piece's box. Shape (k, 3) [m].
    """

    def __init__(self, vertices: Sequence[Points], faces: Sequence[Faces]) -> None:
        self.points: Points = np.concatenate(vertices)
        self.starts = np.cumsum([0, *(len(points) for points in vertices[:-1])])
        self.low: Points = np.minimum.reduceat(self.points, self.starts)
        self.high: Points = np.maximum.reduceat(self.points, self.starts)
        self._vertices, self._faces = vertices, faces
        self._shapes: dict[int, coal.Convex] = {}

    def turned(self, rotation: Matrix3, pivot: Vector3) -> "Solids":
        """Rotate the pieces about a point of the table frame."""
        return Solids([(points - pivot) @ rotation.T + pivot for points in self._vertices], self._faces)

    def rounded(self, decimals: int) -> "Solids":
        """Round the vertices."""
        return Solids([np.round(points, decimals) for points in self._vertices], self._faces)

    def vertices(self, piece: int) -> Points:
        """The vertices of a piece in the table frame [m]."""
        return self._vertices[piece]

    def faces(self, piece: int) -> Faces:
        """The triangles of a piece, indices into its own vertices."""
        return self._faces[piece]

    def shape(self, piece: int) -> coal.Convex:
        """The coal shape of a piece; made on first use, as most pieces come near to nothing."""
        if piece not in self._shapes:
            self._shapes[piece] = make_convex_shape(self._vertices[piece], self._faces[piece])
        return self._shapes[piece]


def concatenate_solids(several: Sequence[Solids], offsets: Sequence[Vector3]) -> Solids:
    """Join the pieces of several objects, each translated by its offset."""
    moved = [(s, k, offset) for s, offset in zip(several, offsets, strict=True) for k in range(len(s.starts))]
    return Solids([s.vertices(k) + offset for s, k, offset in moved], [s.faces(k) for s, k, _ in moved])


def place_pieces(pieces: ConvexPieces, pose: Pose, scale: float) -> Solids:
    """Place the pieces of one object in the table frame: `R(q) @ (scale * vertex) + position`."""
    vertices = [transform_points(pose, hull.vertices, scale) for hull in pieces.hulls]
    return Solids(vertices, [hull.faces for hull in pieces.hulls])


def find_overlapping_boxes(
    a: Solids, b: Solids, margin: float = 0.0, offset: Vector3 | None = None
) -> list[tuple[int, int]]:
    """Find pairs (piece of `a`, piece of `b`) whose boxes come within `margin` [m], with `a` moved by `offset` [m]."""
    shift = np.zeros(3) if offset is None else offset
    low, high = a.low + shift, a.high + shift
    apart = (low[:, None] > b.high[None] + margin) | (b.low[None] > high[:, None] + margin)
    return [(int(i), int(j)) for i, j in np.argwhere(~apart.any(axis=2))]


def find_near_pieces(
    a: Solids, b: Solids, reach_m: float, offset: Vector3 | None = None, signed: bool = True
) -> Iterator[tuple[float, coal.DistanceResult]]:
    """Find pairs of pieces that come within `reach_m` [m], with `a` moved by `offset` [m].

    Args:
        a: Some pieces.
        b: Others, in the same frame.
        reach_m: Pairs further apart than this are left out [m].
        offset: Moves `a` [m].
        signed: Whether gaps of pieces that overlap are negative; else they are 0, for less work.

    Yields:
        The gap [m] and coal's result, whose object is reused for the next pair.
    """
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = signed
    moved, still = coal.Transform3s(), coal.Transform3s()
    if offset is not None:
        moved.setTranslation(offset)
    for i, j in find_overlapping_boxes(a, b, reach_m, offset):
        result.clear()
        gap = float(coal.distance(a.shape(i), moved, b.shape(j), still, request, result))
        if gap <= reach_m:
            yield gap, result


def make_convex_shape(points: Points, faces: Faces) -> coal.Convex:
    """Make a coal shape of a convex triangle mesh."""
    vertices = coal.StdVec_Vec3s()
    vertices.extend(list(points))
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(a, b, c) for a, b, c in faces.tolist()])
    return coal.Convex(vertices, triangles)
