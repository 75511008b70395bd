"""Part A by rules: whether the scene is usable for a table-top robot."""

from itertools import combinations, pairwise
from typing import Literal

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from schemas.curation import Usability
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.relations.relations import BodyFeatures, measure_outline_gap
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.lexicon import is_non_tabletop

WORKSPACE_M = 1.5  # longest side of the layout that one arm covers: twice a Panda's reach less its base
MIN_BAND_M = 0.10  # narrowest band of bare table that separates groups: about the width of a gripper's hand
MAX_TABLETOP_M = 1.2
_CLEAR_STEP = 2.0  # ratio of a gap between clusters to the next smaller gap


def judge_usability(case: JudgeInput) -> Usability:
    """Decide the gate: regional partition by geometry, objects that belong on no table by name and size."""
    misfits = tuple(
        index
        for index, item in enumerate(case.items)
        if is_non_tabletop(item.label) or float(item.size.max()) > MAX_TABLETOP_M
    )
    codes: list[Literal["EXTREME_REGIONAL_PARTITION", "NON_TABLETOP_OBJECT"]] = []
    if is_partitioned(case.bodies):
        codes.append("EXTREME_REGIONAL_PARTITION")
    if misfits:
        codes.append("NON_TABLETOP_OBJECT")
    return Usability(
        usable=not codes, reason_codes=tuple(codes), evidence_ids={"NON_TABLETOP_OBJECT": misfits} if misfits else {}
    )


def is_partitioned(bodies: tuple[BodyFeatures, ...]) -> bool:
    """Whether the bare table between two groups of objects measures more than the larger group does, from above.

    The groups are what is left of the minimum spanning tree over the gaps between outlines when its widest gap is
    cut, or all gaps that stand out. Also true where the objects reach over more than one arm's workspace.
    """
    if _measure_extent(bodies) > WORKSPACE_M:
        return True
    if len(bodies) < 2:
        return False
    gaps, ends = _span_tree(bodies)
    for cut in _find_cuts(gaps):
        clusters = _split_clusters(len(bodies), ends[gaps < cut])
        larger = max(_measure_extent(tuple(bodies[i] for i in cluster)) for cluster in clusters)
        if cut > max(larger, MIN_BAND_M):
            return True
    return False


def _measure_extent(bodies: tuple[BodyFeatures, ...]) -> float:
    points = np.concatenate([body.outline for body in bodies])
    try:
        return 2 * float(fit_min_rectangle(points).half_size.max())
    except GeometryError:  # all on one line
        return float(np.linalg.norm(np.ptp(points, axis=0)))


def _span_tree(bodies: tuple[BodyFeatures, ...]) -> tuple[np.ndarray, np.ndarray]:
    gaps = np.zeros((len(bodies), len(bodies)))
    for (i, a), (j, b) in combinations(enumerate(bodies), 2):
        gaps[i, j] = max(measure_outline_gap(a, b), 1e-6)  # a sparse zero would be no edge
    tree = minimum_spanning_tree(gaps).tocoo()
    return tree.data, np.stack([tree.row, tree.col], axis=1)


def _find_cuts(gaps: np.ndarray) -> list[float]:
    widest, *rest = np.sort(gaps)[::-1].tolist()
    return [widest, *(wider for wider, narrower in pairwise(rest) if wider > _CLEAR_STEP * max(narrower, 0.001))]


def _split_clusters(count: int, edges: np.ndarray) -> list[list[int]]:
    label = np.arange(count)
    for a, b in edges:
        label[label == label[a]] = label[b]
    return [np.flatnonzero(label == value).tolist() for value in np.unique(label)]
