"""Convex decomposition: cut a closed solid across principal axes, then merge the pieces that lose least.

Minimised is the volume that the hulls add to the solid. Hull volumes of both sides of a cut need no Boolean, only the
points on either side and where the plane crosses the edges, so that hundreds of cuts are weighed in the time of one.
The chosen cuts are exact: together the hulls of the parts cover the solid.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace

import manifold3d
import numpy as np
from jaxtyping import Int64

from schemas.geometry import Points, Vector3
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.hulls import compute_hull_volume, find_extreme_points, make_hull_mesh

CUT_POSITIONS = (0.25, 0.5, 0.75)  # where a part may be cut, as shares of its extent along an axis
# Where no cut saves this share of a part's excess, the part is halved across its longest axis: shells (bowls, plates)
# gain nothing from one cut but much from many, and halves lead to compact patches.
MIN_SAVING_SHARE = 0.3
OVERCUT = 1.5  # cutting goes on to this many times the pieces allowed: merging makes better pieces than cutting alone
CUT_SHARE = 0.5  # cutting goes on to this share of the volume error allowed; merging spends the rest
NEGLIGIBLE_SHARE = 1e-9  # parts of less than this share of the solid's volume are rounding, and left out
MERGE_REACH = 0.01  # parts whose boxes come this near (the solid measures 1) may be merged


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    solid: manifold3d.Manifold
    points: Points
    edges: Int64[np.ndarray, "m 2"]
    excess: float


@dataclass(frozen=True, slots=True, eq=False)
class PieceCluster:
    """Corners of the hull of one piece, and the volume of that hull.

    The outline is the few corners that decide its shape: `low` and `high` are its box, and differences are taken
    between volumes of outlines. `halves` are the two clusters that this one was merged from, or none.
    """

    points: Points
    outline: Points
    low: Vector3
    high: Vector3
    volume: float
    outline_volume: float
    halves: tuple["PieceCluster", ...] = ()


def cut_and_merge(solid: manifold3d.Manifold, max_pieces: int, volume_error: float) -> list[PieceCluster]:
    """Decompose a solid of extent 1 into point clusters, in a fixed order, whose hulls together cover it.

    Hulls may add up to `volume_error` of the solid's volume, if `max_pieces` allows.
    """
    volume, most = float(solid.volume()), int(OVERCUT * max_pieces)
    parts = _cut(solid, most, CUT_SHARE * volume_error * volume, NEGLIGIBLE_SHARE * volume)
    clusters = [make_cluster(points) for points in _group_parts([part.points for part in parts], most)]
    return merge_clusters(clusters, max_pieces, (1.0 + volume_error) * volume)


def make_cluster(points: Points) -> PieceCluster:
    """Make the cluster of some points."""
    corners = make_hull_mesh(points).vertices
    outline = find_extreme_points(corners)
    return PieceCluster(corners, outline, *aabb(outline), compute_hull_volume(corners), compute_hull_volume(outline))


def _cut(solid: manifold3d.Manifold, max_parts: int, excess_allowed: float, negligible: float) -> list[_Part]:
    """Cut the part of greatest excess, again and again."""
    parts = dict(enumerate(_split_shells(solid, negligible)))
    waiting = [(-part.excess, key) for key, part in parts.items()]
    heapq.heapify(waiting)
    key = len(parts)
    total = sum(part.excess for part in parts.values())
    while waiting and len(parts) < max_parts and total > excess_allowed:
        _, worst = heapq.heappop(waiting)
        normal, offset = _choose_plane(parts[worst])
        sides = parts[worst].solid.split_by_plane(normal, offset)
        halves = [part for side in sides for part in _split_shells(side, negligible)]
        if len(halves) < 2:  # thinner than rounding: it stays whole
            continue
        total += sum(part.excess for part in halves) - parts.pop(worst).excess
        for part in halves:
            parts[key] = part
            heapq.heappush(waiting, (-part.excess, key))
            key += 1
    return list(parts.values())


def _group_parts(parts: Sequence[Points], most: int) -> list[Points]:
    """Group parts to at most `most` sets of points by repeated halving: merging pairs of thousands would take hours."""
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


def _split_shells(solid: manifold3d.Manifold, negligible: float) -> list[_Part]:
    return [_make_part(piece) for piece in solid.decompose() if piece.volume() > negligible]


def _make_part(solid: manifold3d.Manifold) -> _Part:
    mesh = solid.to_mesh64()
    points = np.array(mesh.vert_properties[:, :3])
    faces = np.array(mesh.tri_verts, dtype=np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return _Part(solid, points, edges[edges[:, 0] < edges[:, 1]], compute_hull_volume(points) - float(solid.volume()))


def _choose_plane(part: _Part) -> tuple[Vector3, float]:
    """Choose the best plane across a principal axis; the middle of the longest where none saves enough."""
    centred = part.points - part.points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1].T
    candidates = [_weigh_cut(part, axis, share) for axis in axes for share in CUT_POSITIONS]
    volume, axis, offset = min(candidates, key=lambda candidate: candidate[0])
    whole = compute_hull_volume(find_extreme_points(part.points))
    if whole - volume < MIN_SAVING_SHARE * part.excess:
        extents = np.ptp(part.points @ axes.T, axis=0)
        axis = axes[int(np.argmax(extents))]
        heights = part.points @ axis
        offset = float(heights.min() + heights.max()) / 2
    return axis, offset


def _weigh_cut(part: _Part, axis: Vector3, share: float) -> tuple[float, Vector3, float]:
    """Compute the volume of the two hulls that a cut leaves; returned with the cut."""
    heights = part.points @ axis
    offset = float(heights.min() * (1.0 - share) + heights.max() * share)
    above = heights - offset
    start, end = above[part.edges[:, 0]], above[part.edges[:, 1]]
    crossing = start * end < 0.0
    weight = (start[crossing] / (start[crossing] - end[crossing]))[:, None]
    first, second = part.points[part.edges[crossing, 0]], part.points[part.edges[crossing, 1]]
    rim = first * (1.0 - weight) + second * weight
    upper = find_extreme_points(np.concatenate([part.points[above >= 0.0], rim]))
    lower = find_extreme_points(np.concatenate([part.points[above < 0.0], rim]))
    return compute_hull_volume(upper) + compute_hull_volume(lower), axis, offset


def merge_clusters(clusters: Sequence[PieceCluster], max_pieces: int, volume_allowed: float) -> list[PieceCluster]:
    """Merge the pair whose common hull adds least, again and again, within what is allowed."""
    alive = dict(enumerate(clusters))
    near = [(i, j) for i in alive for j in range(i) if _are_near(alive[i], alive[j])]
    waiting = [(_compute_added_volume(alive[i], alive[j]), i, j) for i, j in near]
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
        merged = replace(make_cluster(np.concatenate([first.points, second.points])), halves=(first, second))
        total += merged.volume - first.volume - second.volume
        for k, other in alive.items():
            if _are_near(merged, other):
                heapq.heappush(waiting, (_compute_added_volume(merged, other), key, k))
        alive[key] = merged
        key += 1
    return list(alive.values())


def _compute_added_volume(a: PieceCluster, b: PieceCluster) -> float:
    return compute_hull_volume(np.concatenate([a.outline, b.outline])) - a.outline_volume - b.outline_volume


def _are_near(a: PieceCluster, b: PieceCluster) -> bool:
    return bool((np.maximum(a.low, b.low) <= np.minimum(a.high, b.high) + MERGE_REACH).all())
