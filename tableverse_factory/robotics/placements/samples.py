"""Places that were sampled, in the order in which they are worth a closer look."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.geometry import Frozen
from tableverse_factory.robotics.placements.domains import Points2, Vector2

SPREAD_M = 0.02
"""Places nearer than this at the same heading are alike: a planner that fails at one will fail at the other."""

AWAY_M = 0.04
"""Where the relation holds already, nearer places than this to where the object is come last."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples(Frozen):
    """Places of one or of all headings.

    Attributes:
        heading: Index of the heading. Shape (n,).
        cells: By how many cells of its map the turned object is moved. Shape (n, 2).
        middles: Middle of its box there. Shape (n, 2) [m].
        costs: What speaks against each place. Shape (n,).
        clear: Whether boxes keep clear there. Shape (n,).
    """

    heading: Int64[np.ndarray, " n"]
    cells: Int64[np.ndarray, "n 2"]
    middles: Points2
    costs: Float64[np.ndarray, " n"]
    clear: Bool[np.ndarray, " n"]

    def order(self, avoided: Vector2 | None) -> list[int]:
        """Indices: where boxes are clear, then the others; of each the cheapest first, but those alike at the end.

        Args:
            avoided: What lies within `AWAY_M` of this comes after all others [m].
        """
        late = np.zeros(len(self.costs), dtype=bool)
        if avoided is not None:
            late = np.linalg.norm(self.middles - avoided, axis=1) < AWAY_M
        order: list[int] = []
        for part in (self.clear & ~late, ~self.clear & ~late, late):
            cheapest = np.flatnonzero(part)[np.argsort(self.costs[part], kind="stable")]
            order += self._varied(cheapest)
        return order

    def _varied(self, order: Int64[np.ndarray, " k"]) -> list[int]:
        """The same indices, the first of each kind before all their likes."""
        left, firsts = order, list[int]()
        while len(left):
            first = left[0]
            firsts.append(int(first))
            near = (np.abs(self.middles[left] - self.middles[first]) < SPREAD_M).all(axis=1)
            left = left[~(near & (self.heading[left] == self.heading[first]))]
        return [*firsts, *map(int, order[~np.isin(order, firsts)])]


def joined(parts: Sequence[Samples]) -> Samples:
    """The samples of several headings as one."""
    names = ("heading", "cells", "middles", "costs", "clear")
    return Samples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
