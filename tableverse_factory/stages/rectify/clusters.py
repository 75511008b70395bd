"""Clusters of things that touch are relaxed apart from one another, so that a heap costs what is in it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from tableverse_factory.core.errors import SolverError
from tableverse_factory.stages.rectify.fault_check import are_near
from tableverse_factory.stages.rectify.groups import components
from tableverse_factory.stages.rectify.relaxation import Relaxation, SolverBudget
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tableverse_factory.stages.rectify.support import SupportRelation

Cluster = tuple[int, ...]
"""Indices of parts, ascending."""

LINK_M = 0.01
"""Things with a gap of at most this are of one cluster from the start [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Relaxed:
    """A layout after its clusters were relaxed.

    Attributes:
        parts: Where they are; those of a cluster without an answer where they were.
        unsolved: Parts of the clusters whose least motion is too much work or was not found.
    """

    parts: tuple[RigidPart, ...]
    unsolved: frozenset[int]


def relaxed(parts: Sequence[RigidPart], support: SupportRelation, clearance_m: float) -> Relaxed:
    """The least motion of every cluster; clusters that would meet on their ways are one.

    All share one allowance of work, the smallest first, so that a heap does not take what the others need.

    Args:
        parts: What stands is upright and on the table.
        support: Who carries whom.
        clearance_m: The least gap [m].
    """
    pairs = set(support.pairs) | _near(parts, [(i,) for i in range(len(parts))], LINK_M)
    allowance = SolverBudget()
    known: dict[Cluster, list[RigidPart] | None] = {}
    while True:
        moved, solved = list(parts), []
        for cluster in sorted(components(sorted(pairs), len(parts)), key=lambda found: (len(found), found)):
            if cluster not in known:
                known[cluster] = _relaxation(parts, cluster, support, clearance_m, allowance)
            ended = known[cluster]
            if ended is not None:
                solved.append(cluster)
                for i, part in zip(cluster, ended, strict=True):
                    moved[i] = part
        met = _near(moved, solved, clearance_m)
        if not met:
            return Relaxed(tuple(moved), frozenset(range(len(parts))) - {i for cluster in solved for i in cluster})
        pairs |= met


def _relaxation(
    parts: Sequence[RigidPart], cluster: Cluster, support: SupportRelation, clearance_m: float, allowance: SolverBudget
) -> list[RigidPart] | None:
    """The parts of a cluster after their least motion; None where there is no answer."""
    own = [parts[i] for i in cluster]
    if len(own) == 1:
        return own
    try:
        return Relaxation(own, support.of(cluster), clearance_m, allowance).result()
    except SolverError:
        return None


def _near(parts: Sequence[RigidPart], clusters: Sequence[Cluster], reach_m: float) -> set[tuple[int, int]]:
    """Pairs of parts of different clusters that are nearer than a reach."""
    return {(i, j) for a, b in combinations(clusters, 2) for i in a for j in b if are_near(parts[i], parts[j], reach_m)}
