"""What filling the containers of one scene may cost: counted in work, not in seconds, so that a result repeats."""

from dataclasses import dataclass

OUT_OF_BUDGET = "filling the containers of this scene took as much work as it may"


@dataclass(slots=True)
class SimulationBudget:
    """What is left; each drop or look that was begun is ended.

    Attributes:
        dropping_s: Simulated time for dropping things one by one [s].
        freeing_s: Simulated time for freeing together what is in [s]. It is kept apart, or a scene that ran out would
            lose what it has.
        comparisons: Of two convex pieces each, to find a free start for a fall.
    """

    dropping_s: float = 60.0
    freeing_s: float = 60.0
    comparisons: int = 24_000_000

    @property
    def may_drop(self) -> bool:
        """Whether another thing may be dropped."""
        return self.dropping_s > 0.0 and self.comparisons > 0

    @property
    def may_free(self) -> bool:
        """Whether the contents of a container may be freed together."""
        return self.freeing_s > 0.0
