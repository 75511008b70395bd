"""Clusters of points as pieces of few vertices; merges are taken back where those vertices cost too much volume."""

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import manifold3d

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.convex.cut_and_merge import PieceCluster
from tableverse_factory.geometry.mesh.hulls import bounded_hull, hull_of
from tableverse_factory.geometry.mesh.mass_integrals import signed_volume

MAX_HULL_VERTICES = 64
"""MuJoCo and GPU simulators are fast up to here."""
HULL_TOLERANCE = 4e-4
"""Points this near to a hull need no corner of their own. Lengths here are shares of the mesh's longest side."""


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    hull: TriangleMesh
    volume: float
    cluster: PieceCluster


def piece_of(points: Points) -> TriangleMesh:
    """A hull of at most `MAX_HULL_VERTICES` that covers the points, or nearly."""
    return bounded_hull(points, MAX_HULL_VERTICES, HULL_TOLERANCE)


def bounded_pieces(clusters: Sequence[PieceCluster], max_pieces: int, volume_allowed: float) -> list[TriangleMesh]:
    """A piece for each cluster, or for the two it was merged from, those first where this saves most.

    Args:
        clusters: As `cut_and_merge` gives them.
        max_pieces: No more pieces than this, unless there are more clusters.
        volume_allowed: Volume of the union of the pieces beyond which merges are taken back. Afterwards only sums are
            looked at, and the share of them that overlaps is taken to stay what it was.
    """
    pieces = {k: _piece(cluster) for k, cluster in enumerate(clusters)}
    total = sum(piece.volume for piece in pieces.values())
    sum_allowed = volume_allowed * total / _united_volume(pieces.values()) if total > volume_allowed else total
    if total <= sum_allowed:
        return [piece.hull for piece in pieces.values()]
    waiting: list[tuple[float, int, list[_Piece]]] = []
    for k, piece in pieces.items():
        _offer(waiting, k, piece)
    key = len(pieces)
    while waiting and total > sum_allowed and len(pieces) < max_pieces:
        saving, k, halves = heapq.heappop(waiting)
        del pieces[k]
        total += saving
        for half in halves:
            pieces[key] = half
            _offer(waiting, key, half)
            key += 1
    return [piece.hull for piece in pieces.values()]


def _united_volume(pieces: Iterable[_Piece]) -> float:
    solids = [hull_of(piece.hull.vertices) for piece in pieces]
    return float(manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).volume())


def _offer(waiting: list[tuple[float, int, list[_Piece]]], key: int, piece: _Piece) -> None:
    """Puts a merged piece on the heap with what taking it back changes (negative: a saving)."""
    if piece.cluster.halves:
        halves = [_piece(half) for half in piece.cluster.halves]
        heapq.heappush(waiting, (sum(half.volume for half in halves) - piece.volume, key, halves))


def _piece(cluster: PieceCluster) -> _Piece:
    hull = piece_of(cluster.points)
    return _Piece(hull, signed_volume(hull), cluster)
