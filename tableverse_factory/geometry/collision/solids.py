"""Convex pieces in the table frame, for exact distance queries."""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import coal
import numpy as np

from schemas.geometry import ConvexPieces, Faces, Matrix3, Points, Pose, Vector3
from tableverse_factory.geometry.math.transforms import transform_points


class Solids:
    """The k pieces of one object in the table frame, with the box of each (k, 3) [m].

    `points` are the vertices of all pieces (n, 3) [m], which begin at `starts` (k,); `vertices` and `faces` are theirs.
    """

    def __init__(self, vertices: Sequence[Points], faces: Sequence[Faces]) -> None:
        self.points: Points = np.concatenate(vertices)
        self.starts = np.cumsum([0, *(len(points) for points in vertices[:-1])])
        self.low: Points = np.minimum.reduceat(self.points, self.starts)
        self.high: Points = np.maximum.reduceat(self.points, self.starts)
        self.vertices, self.faces = vertices, faces
        self._shapes: dict[int, coal.Convex] = {}

    def turned(self, rotation: Matrix3, pivot: Vector3) -> "Solids":
        """Rotate the pieces about a point of the table frame."""
        return Solids([(points - pivot) @ rotation.T + pivot for points in self.vertices], self.faces)

    def rounded(self, decimals: int) -> "Solids":
        """Round the vertices."""
        return Solids([np.round(points, decimals) for points in self.vertices], self.faces)

    def shape(self, piece: int) -> coal.Convex:
        """The coal shape of a piece; made on first use, as most pieces come near to nothing."""
        if piece not in self._shapes:
            self._shapes[piece] = make_convex_shape(self.vertices[piece], self.faces[piece])
        return self._shapes[piece]


def concatenate_solids(several: Sequence[Solids], offsets: Sequence[Vector3]) -> Solids:
    """Join the pieces of several objects, each translated by its offset."""
    moved = [(s, k, offset) for s, offset in zip(several, offsets, strict=True) for k in range(len(s.starts))]
    return Solids([s.vertices[k] + offset for s, k, offset in moved], [s.faces[k] for s, k, _ in moved])


def place_pieces(pieces: ConvexPieces, pose: Pose, scale: float) -> Solids:
    """Place the pieces of one object in the table frame: `R(q) @ (scale * vertex) + position`."""
    vertices = [transform_points(pose, hull.vertices, scale) for hull in pieces.hulls]
    return Solids(vertices, [hull.faces for hull in pieces.hulls])


def find_near_pieces(
    a: Solids, b: Solids, reach_m: float, offset: Vector3 | None = None, signed: bool = True
) -> Iterator[tuple[float, coal.DistanceResult]]:
    """Find pairs of pieces that come within `reach_m` [m], with `a` moved by `offset` [m].

    Yields the gap [m] and coal's result, whose object is reused for the next pair. Gaps of pieces that overlap are
    negative if `signed`, else 0, for less work.
    """
    shift = np.zeros(3) if offset is None else offset
    low, high = a.low + shift, a.high + shift
    near = ~((low[:, None] > b.high[None] + reach_m) | (b.low[None] > high[:, None] + reach_m)).any(axis=2)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = signed
    moved, still = coal.Transform3s(np.eye(3), shift), coal.Transform3s()
    for i, j in np.argwhere(near).tolist():
        result.clear()
        gap = float(coal.distance(a.shape(i), moved, b.shape(j), still, request, result))
        if gap <= reach_m:
            yield gap, result


def make_convex_shape(points: Points, faces: Faces) -> coal.Convex:
    """Make a coal shape of a convex triangle mesh."""
    vertices = coal.StdVec_Vec3s()
    vertices.extend(list(points))
    return coal.Convex(vertices, _list_triangles(np.asarray(faces, dtype=np.int64).tobytes()))


@lru_cache(4096)  # most work of a shape, and the same wherever a piece stands
def _list_triangles(faces: bytes) -> coal.StdVec_Triangle:
    triangles = coal.StdVec_Triangle()
    triangles.extend(
        [coal.Triangle(a, b, c) for a, b, c in np.frombuffer(faces, dtype=np.int64).reshape(-1, 3).tolist()]
    )
    return triangles
