"""A closed solid as few convex pieces: cut across principal axes, then merge what loses least.

The aim is one number: the volume that the hulls add to the solid. Hull volumes of both sides of a cut need no Boolean,
only the points on either side and where the plane crosses the edges, so that hundreds of cuts can be weighed in the
time of one. Parts come from exact cuts: together their hulls cover the solid.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace

import manifold3d
import numpy as np
from jaxtyping import Int64

from schemas.geometry import Matrix3, Points, Vector3
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.hulls import extreme_points, hull_mesh, hull_volume

CUTS_AT = (0.25, 0.5, 0.75)
"""Where a part may be cut, as shares of its extent along an axis."""
WORTHWHILE = 0.3
"""A cut that saves less than this share of a part's excess is not taken: the part is halved across its longest axis.

Shells (bowls, plates) gain nothing from any one cut, and all from many: halves lead to compact patches."""
OVERCUT = 1.5
"""Cutting goes on to this many times the pieces allowed: merging makes better pieces than cutting alone."""
CUT_SHARE = 0.5
"""Cutting goes on to this share of the volume error allowed; merging spends the rest."""
NEGLIGIBLE = 1e-9
"""Parts of less than this share of the solid's volume are rounding, and left out."""
NEAR = 0.01
"""Parts whose boxes come this near (the solid measures 1) may be merged."""


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    solid: manifold3d.Manifold
    points: Points
    edges: Int64[np.ndarray, "m 2"]
    excess: float


@dataclass(frozen=True, slots=True, eq=False)
class PieceCluster:
    """Points whose hull is one piece.

    Attributes:
        points: Corners of the hull. Shape (n, 3).
        outline: Those that decide its shape, few.
        low: Lowest corner of the outline's box.
        high: Highest corner.
        volume: Of the hull.
        outline_volume: Of the outline's hull; differences are taken between volumes of outlines.
        halves: The two it was merged from, or none.
    """

    points: Points
    outline: Points
    low: Vector3
    high: Vector3
    volume: float
    outline_volume: float
    halves: tuple["PieceCluster", ...] = ()


def cut_and_merge(solid: manifold3d.Manifold, max_pieces: int, volume_error: float) -> list[PieceCluster]:
    """Point clusters, in a fixed order, whose hulls together cover the solid.

    Args:
        solid: Closed, about 1 large, of positive volume.
        max_pieces: No more clusters than this.
        volume_error: Hulls may add up to this share of the solid's volume, if `max_pieces` allows.
    """
    volume, most = float(solid.volume()), int(OVERCUT * max_pieces)
    parts = _cut(solid, most, CUT_SHARE * volume_error * volume, NEGLIGIBLE * volume)
    clusters = [cluster_of(points) for points in _gathered([part.points for part in parts], most)]
    return _merge(clusters, max_pieces, (1.0 + volume_error) * volume)


def cluster_of(points: Points) -> PieceCluster:
    """A cluster of points, its outline found."""
    corners = hull_mesh(points).vertices
    outline = extreme_points(corners)
    return PieceCluster(corners, outline, *aabb(outline), hull_volume(corners), hull_volume(outline))


def _cut(solid: manifold3d.Manifold, max_parts: int, excess_allowed: float, negligible: float) -> list[_Part]:
    """Cuts the part of greatest excess, again and again."""
    parts = dict(enumerate(_parts(solid, negligible)))
    waiting = [(-part.excess, key) for key, part in parts.items()]
    heapq.heapify(waiting)
    key = len(parts)
    total = sum(part.excess for part in parts.values())
    while waiting and len(parts) < max_parts and total > excess_allowed:
        _, worst = heapq.heappop(waiting)
        normal, offset = _plane(parts[worst])
        halves = [
            part for side in parts[worst].solid.split_by_plane(normal, offset) for part in _parts(side, negligible)
        ]
        if len(halves) < 2:  # thinner than rounding: it stays whole
            continue
        total += sum(part.excess for part in halves) - parts.pop(worst).excess
        for part in halves:
            parts[key] = part
            heapq.heappush(waiting, (-part.excess, key))
            key += 1
    return list(parts.values())


def _gathered(parts: Sequence[Points], most: int) -> list[Points]:
    """At most so many sets of points: of solids in many shells neighbours are put together, halves of halves.

    Weighing each pair of thousands of shells would take hours.
    """
    if len(parts) <= most:
        return list(parts)
    centers = np.array([(part.min(axis=0) + part.max(axis=0)) / 2 for part in parts])
    groups = [np.arange(len(parts))]
    while len(groups) < most:
        largest = max(range(len(groups)), key=lambda k: len(groups[k]))
        group = groups.pop(largest)
        axis = int(np.argmax(np.ptp(centers[group], axis=0)))
        order = group[np.argsort(centers[group, axis], kind="stable")]
        groups += [order[: len(order) // 2], order[len(order) // 2 :]]
    return [np.concatenate([parts[k] for k in group.tolist()]) for group in groups]


def _parts(solid: manifold3d.Manifold, negligible: float) -> list[_Part]:
    return [_part(piece) for piece in solid.decompose() if piece.volume() > negligible]


def _part(solid: manifold3d.Manifold) -> _Part:
    mesh = solid.to_mesh64()
    points = np.array(mesh.vert_properties[:, :3])
    faces = np.array(mesh.tri_verts, dtype=np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return _Part(solid, points, edges[edges[:, 0] < edges[:, 1]], hull_volume(points) - float(solid.volume()))


def _plane(part: _Part) -> tuple[Vector3, float]:
    """The best plane across a principal axis; the middle of the longest where none is worth it."""
    axes = _principal_axes(part.points)
    candidates = [_weighed(part, axis, share) for axis in axes for share in CUTS_AT]
    volume, axis, offset = min(candidates, key=lambda candidate: candidate[0])
    whole = hull_volume(extreme_points(part.points))
    if whole - volume < WORTHWHILE * part.excess:
        extents = np.ptp(part.points @ axes.T, axis=0)
        axis = axes[int(np.argmax(extents))]
        heights = part.points @ axis
        offset = float(heights.min() + heights.max()) / 2
    return axis, offset


def _weighed(part: _Part, axis: Vector3, share: float) -> tuple[float, Vector3, float]:
    """Volume of the two hulls that a cut leaves, and the cut."""
    heights = part.points @ axis
    offset = float(heights.min() * (1.0 - share) + heights.max() * share)
    above = heights - offset
    start, end = above[part.edges[:, 0]], above[part.edges[:, 1]]
    crossing = start * end < 0.0
    weight = (start[crossing] / (start[crossing] - end[crossing]))[:, None]
    first, second = part.points[part.edges[crossing, 0]], part.points[part.edges[crossing, 1]]
    rim = first * (1.0 - weight) + second * weight
    upper = np.concatenate([part.points[above >= 0.0], rim])
    lower = np.concatenate([part.points[above < 0.0], rim])
    return hull_volume(extreme_points(upper)) + hull_volume(extreme_points(lower)), axis, offset


def _principal_axes(points: Points) -> Matrix3:
    """Rows: the eigenvectors of the points' covariance."""
    centred = points - points.mean(axis=0)
    axes: Matrix3 = np.linalg.eigh(centred.T @ centred)[1].T
    return axes


def _merge(clusters: Sequence[PieceCluster], max_pieces: int, volume_allowed: float) -> list[PieceCluster]:
    """Merges the pair whose common hull adds least, again and again, within what is allowed."""
    alive = dict(enumerate(clusters))
    waiting = [(_added(alive[i], alive[j]), i, j) for i in alive for j in range(i) if _are_near(alive[i], alive[j])]
    heapq.heapify(waiting)
    total = sum(cluster.volume for cluster in clusters)
    key = len(clusters)
    while waiting:
        added, i, j = heapq.heappop(waiting)
        if i not in alive or j not in alive:
            continue
        if len(alive) <= max_pieces and total + added > volume_allowed:
            break
        first, second = alive.pop(j), alive.pop(i)
        merged = replace(cluster_of(np.concatenate([first.points, second.points])), halves=(first, second))
        total += merged.volume - first.volume - second.volume
        for k, other in alive.items():
            if _are_near(merged, other):
                heapq.heappush(waiting, (_added(merged, other), key, k))
        alive[key] = merged
        key += 1
    return list(alive.values())


def _added(a: PieceCluster, b: PieceCluster) -> float:
    return hull_volume(np.concatenate([a.outline, b.outline])) - a.outline_volume - b.outline_volume


def _are_near(a: PieceCluster, b: PieceCluster) -> bool:
    return bool((np.maximum(a.low, b.low) <= np.minimum(a.high, b.high) + NEAR).all())
