"""Sampled placements, ranked for close inspection."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.geometry import Frozen
from tableverse_factory.robotics.placements.domains import Points2, Vector2

ALIKE_RADIUS_M = 0.02
"""Placements nearer than this at one heading are alike: a planner that fails at one will fail at the other."""

AVOIDED_RADIUS_M = 0.04  # placements nearer than this to an avoided point come last


@dataclass(frozen=True, slots=True, eq=False)
class PlacementSamples(Frozen):
    """Samples of one or of all headings.

    Attributes:
        heading: Index of the heading. Shape (n,).
        cells: Offset of the rotated object in cells of its map. Shape (n, 2).
        middles: Middle of its box there. Shape (n, 2) [m].
        costs: Lower is better. Shape (n,).
        clear: Whether boxes are clear there. Shape (n,).
    """

    heading: Int64[np.ndarray, " n"]
    cells: Int64[np.ndarray, "n 2"]
    middles: Points2
    costs: Float64[np.ndarray, " n"]
    clear: Bool[np.ndarray, " n"]

    def rank(self, avoided: Vector2 | None) -> list[int]:
        """Rank indices: clear boxes, then others, then those near `avoided` [m]; each by cost, alike ones last."""
        late = np.zeros(len(self.costs), dtype=bool)
        if avoided is not None:
            late = np.linalg.norm(self.middles - avoided, axis=1) < AVOIDED_RADIUS_M
        order: list[int] = []
        for part in (self.clear & ~late, ~self.clear & ~late, late):
            cheapest = np.flatnonzero(part)[np.argsort(self.costs[part], kind="stable")]
            order += self._put_alike_last(cheapest)
        return order

    def _put_alike_last(self, order: Int64[np.ndarray, " k"]) -> list[int]:
        left, firsts = order, list[int]()
        while len(left):
            first = left[0]
            firsts.append(int(first))
            near = (np.abs(self.middles[left] - self.middles[first]) < ALIKE_RADIUS_M).all(axis=1)
            left = left[~(near & (self.heading[left] == self.heading[first]))]
        return [*firsts, *map(int, order[~np.isin(order, firsts)])]


def concatenate_samples(parts: Sequence[PlacementSamples]) -> PlacementSamples:
    """Concatenate the samples of several headings."""
    names = ("heading", "cells", "middles", "costs", "clear")
    return PlacementSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
