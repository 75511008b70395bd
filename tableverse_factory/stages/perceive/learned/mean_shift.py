"""Clustering of pixels by their votes for the object's centre: mean shift over a grid of votes."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from schemas.geometry import Points

CELL_M = 0.008
BANDWIDTH_M = 0.018
SAME_M = 0.018
ROUNDS = 12


def cluster_votes(votes: Points, least: int) -> Int64[np.ndarray, " n"]:
    """Cluster the votes in the table frame [m]: the cluster of each from 0, -1 for those whose peak has too few.

    The same votes in any order give the same clusters, numbered by falling size.
    """
    if not len(votes):
        return np.zeros(0, dtype=np.int64)
    cells, cell_of, counts = np.unique(
        np.floor(votes / CELL_M).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    cell_of = cell_of.ravel()
    middles = (cells + 0.5) * CELL_M
    peaks = _climb(middles, counts.astype(np.float64))
    peak_of = _merge_peaks(peaks, counts)[cell_of]
    sizes = np.bincount(peak_of)
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty(len(sizes), dtype=np.int64)
    rank[order] = np.arange(len(sizes))
    rank[sizes < least] = -1
    return rank[peak_of]


def _climb(middles: Points, counts: Float64[np.ndarray, " c"]) -> Points:
    """Move each cell repeatedly to the weighted mean of the votes around it."""
    tree, places = cKDTree(middles), middles
    for _ in range(ROUNDS):
        near = tree.query_ball_point(places, 2.5 * BANDWIDTH_M, return_sorted=True)
        rows = np.repeat(np.arange(len(places)), [len(found) for found in near])
        columns = np.concatenate([np.asarray(found, dtype=np.int64) for found in near])
        squared = ((middles[columns] - places[rows]) ** 2).sum(axis=1)
        weight = counts[columns] * np.exp(-0.5 * squared / BANDWIDTH_M**2)
        total = np.bincount(rows, weight, len(places))
        sums = [np.bincount(rows, weight * middles[columns, k], len(places)) for k in range(3)]
        places = np.stack(sums, axis=1) / total[:, None]
    return places


def _merge_peaks(peaks: Points, counts: Int64[np.ndarray, " c"]) -> Int64[np.ndarray, " c"]:
    """Number the cells by peak: cells whose peaks lie together share a number, the fullest cell's first."""
    number = np.full(len(peaks), -1, dtype=np.int64)
    tree, count = cKDTree(peaks), 0
    for index in np.argsort(-counts, kind="stable"):
        if number[index] >= 0:
            continue
        near = np.asarray(tree.query_ball_point(peaks[index], SAME_M), dtype=np.int64)
        number[near[number[near] < 0]] = count
        count += 1
    return number
