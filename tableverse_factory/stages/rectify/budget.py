"""Budget for filling the containers of one scene, counted in work, not in seconds, so that results repeat."""

from dataclasses import dataclass

BUDGET_SPENT = "filling the containers of this scene took as much work as it may"


@dataclass(slots=True)
class SimulationBudget:
    """Remaining budget; each drop or search that was started is finished.

    Attributes:
        dropping_s: Simulated time for dropping contents one by one [s].
        freeing_s: Simulated time for settling the contents together [s]; separate, so that dropping cannot exhaust it.
        comparisons: Of two convex pieces each, to find a free start for a fall.
    """

    dropping_s: float = 60.0
    freeing_s: float = 60.0
    comparisons: int = 24_000_000

    @property
    def may_drop(self) -> bool:
        """Whether another object may be dropped."""
        return self.dropping_s > 0.0 and self.comparisons > 0

    @property
    def may_free(self) -> bool:
        """Whether the contents of a container may be settled together."""
        return self.freeing_s > 0.0
