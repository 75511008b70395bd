"""Relax clusters of touching objects independently of one another, which limits the cost."""

from collections.abc import Sequence
from itertools import combinations

from tableverse_factory.core.errors import SolverError
from tableverse_factory.stages.rectify.fault_check import are_near
from tableverse_factory.stages.rectify.groups import connect_components
from tableverse_factory.stages.rectify.relaxation import Relaxation, SolverBudget
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import SupportRelation

Cluster = tuple[int, ...]  # indices of parts, ascending

LINK_M = 0.01  # objects with a gap of at most this are in one cluster from the start [m]


def relax_layout(
    parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float
) -> tuple[list[RigidPart], set[int]]:
    """Find the least motion of every cluster, where those that would meet are joined; standing parts are upright.

    All share one budget, the smallest first, so that a heap does not use up what the others need. Returns the parts,
    and which of them have not been moved because the least motion of their cluster is too much work or was not found.
    """
    pairs = set(support.pairs) | _find_near_pairs(parts, [(i,) for i in range(len(parts))], LINK_M)
    allowance = SolverBudget()
    known: dict[Cluster, list[RigidPart] | None] = {}
    while True:
        moved, solved = list(parts), []
        for cluster in sorted(connect_components(sorted(pairs), len(parts)), key=lambda found: (len(found), found)):
            if cluster not in known:
                known[cluster] = _relax_cluster(parts, cluster, support, clearance_m, allowance)
            ended = known[cluster]
            if ended is not None:
                solved.append(cluster)
                for i, part in zip(cluster, ended, strict=True):
                    moved[i] = part
        met = _find_near_pairs(moved, solved, clearance_m)
        if not met:
            return moved, set(range(len(parts))) - {i for cluster in solved for i in cluster}
        pairs |= met


def _relax_cluster(
    parts: Sequence[RigidPart], cluster: Cluster, support: SupportRelation, clearance_m: float, allowance: SolverBudget
) -> list[RigidPart] | None:
    own = [parts[i] for i in cluster]
    if len(own) == 1:
        return own
    try:
        return Relaxation(own, support.of(cluster), clearance_m, allowance).result()
    except SolverError:
        return None


def _find_near_pairs(parts: Sequence[RigidPart], clusters: Sequence[Cluster], reach_m: float) -> set[tuple[int, int]]:
    return {(i, j) for a, b in combinations(clusters, 2) for i in a for j in b if are_near(parts[i], parts[j], reach_m)}
