"""Convex pieces of few vertices; merges are undone where the vertex limit costs too much volume."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.geometry.convex.cut_and_merge import PieceCluster
from tableverse_factory.geometry.mesh.hulls import make_bounded_hull, reduce_hull, unite_hulls
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume

MAX_HULL_VERTICES = 64  # muJoCo and GPU simulators are fast up to this number
HULL_TOLERANCE = 4e-4  # points this near to a hull need no corner, as a share of the mesh's longest side


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    hull: TriangleMesh
    volume: float
    cluster: PieceCluster


def make_piece(points: Points) -> TriangleMesh:
    """Make a hull of at most `MAX_HULL_VERTICES` that covers the points, or nearly."""
    return make_bounded_hull(points, MAX_HULL_VERTICES, HULL_TOLERANCE)


def make_bounded_pieces(clusters: Sequence[PieceCluster], max_pieces: int, volume_allowed: float) -> list[TriangleMesh]:
    """Make a piece of each cluster, or of the two it was merged from, where this saves most volume.

    Merges are undone while the union of the pieces has more than `volume_allowed`. After the first union only sums of
    volumes are updated, as if the overlapping share stayed the same.
    """
    pieces = {k: _measure_piece(cluster) for k, cluster in enumerate(clusters)}
    total = sum(piece.volume for piece in pieces.values())
    if total <= volume_allowed or len(pieces) >= max_pieces:
        return [piece.hull for piece in pieces.values()]
    sum_allowed = volume_allowed * total / float(unite_hulls(piece.hull for piece in pieces.values()).volume())
    waiting: list[tuple[float, int, list[_Piece]]] = []
    for k, piece in pieces.items():
        _push_split(waiting, k, piece)
    key = len(pieces)
    while waiting and total > sum_allowed and len(pieces) < max_pieces:
        change, k, halves = heapq.heappop(waiting)
        if not halves:  # `change` is a bound only
            halves = [_measure_piece(half) for half in pieces[k].cluster.halves]
            change = sum(half.volume for half in halves) - pieces[k].volume
            heapq.heappush(waiting, (change, k, halves))
            continue
        del pieces[k]
        total += change
        for half in halves:
            pieces[key] = half
            _push_split(waiting, key, half)
            key += 1
    return [piece.hull for piece in pieces.values()]


def _push_split(waiting: list[tuple[float, int, list[_Piece]]], key: int, piece: _Piece) -> None:
    """Push a merged piece on the heap with the least change of volume that undoing it can bring.

    A piece covers its cluster, so it has at least the volume of the cluster's hull. The two halves are made only when
    no other piece promises to save more.
    """
    if piece.cluster.halves:
        heapq.heappush(waiting, (sum(half.volume for half in piece.cluster.halves) - piece.volume, key, []))


def _measure_piece(cluster: PieceCluster) -> _Piece:
    hull = reduce_hull(cluster.points, MAX_HULL_VERTICES, HULL_TOLERANCE)
    return _Piece(hull, compute_signed_volume(hull), cluster)
