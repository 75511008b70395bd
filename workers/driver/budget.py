"""Budget for questions to models: granted before a scene is sent, settled when it returns."""

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.config import Config, RemoteModelSection
from schemas.outcome import NO_COST, Allowance, ModelCost
from tableverse_factory.models.remote.endpoint import MOST_CALLS
from tableverse_factory.stage import Stage


@dataclass(frozen=True, slots=True)
class SpendingLimits:
    """Upper limits on the cost of a dataset over all runs; None for no limit."""

    calls: int | None = None  # requests to models
    usd: float | None = None  # at the prices of the configuration [USD]


NO_LIMITS = SpendingLimits()


def calls_model(stage: Stage, config: Config) -> bool:
    """Whether a stage sends questions to a model server, which may cost money."""
    section = getattr(config, stage.section)
    return isinstance(section, RemoteModelSection) and bool(section.protocol)


@dataclass(slots=True)
class Budget:
    """Arithmetic of the remaining budget.

    Requests are granted before they are sent, so they never exceed their limit. Their price is unknown before: each
    scene in flight counts as the most expensive one so far, and while no price is known, scenes go one by one.
    """

    limits: SpendingLimits  # of the dataset
    spent: ModelCost  # by finished scenes of the dataset
    max_scene_usd: float | None = None  # most that one scene has cost [USD]; None while no answer had a price
    granted: dict[int, Allowance] = field(default_factory=dict)  # allowances of scenes in flight, by rank
    _run: str = field(default_factory=lambda: secrets.token_hex(4))
    _count: int = 0

    @property
    def is_spent(self) -> bool:
        """Whether a limit is reached, whatever scenes in flight return."""
        calls, usd = self.limits.calls, self.limits.usd
        return (calls is not None and self.spent.calls >= calls) or (usd is not None and self.spent.usd >= usd)

    @property
    def room(self) -> float:
        """Scenes that call a model and may start now; one if none is in flight, because answers may be cached."""
        calls, usd = self._calls_left(), self._usd_left()
        by_calls = math.inf if calls is None else math.ceil(calls / MOST_CALLS)
        if usd is None:
            by_usd = math.inf
        elif usd <= 0.0 or self.max_scene_usd is None:
            by_usd = 0
        else:
            by_usd = math.ceil(usd / self.max_scene_usd) if self.max_scene_usd else math.inf
        return max(min(by_calls, by_usd), 0 if self.granted else 1)

    def grant(self, rank: int) -> Allowance:
        """Grant a scene its allowance, under a name that is unique among all runs."""
        calls, usd = self._calls_left(), self._usd_left()
        self._count += 1
        self.granted[rank] = Allowance(
            None if calls is None else min(MOST_CALLS, calls), usd, f"{self._run}-{self._count}"
        )
        return self.granted[rank]

    def settle(self, rank: int, paid: ModelCost, cost: ModelCost = NO_COST) -> None:
        """Settle the allowance of a scene; `cost`, when answers were first given, tells the price of cached ones."""
        del self.granted[rank]
        self.spent += paid
        usd = max(paid.usd, cost.usd)
        if usd > 0.0 or cost.calls:
            self.max_scene_usd = max(self.max_scene_usd or 0.0, usd)

    def _calls_left(self) -> int | None:
        if self.limits.calls is None:
            return None
        in_flight = sum(allowance.calls or 0 for allowance in self.granted.values())
        return max(self.limits.calls - self.spent.calls - in_flight, 0)

    def _usd_left(self) -> float | None:
        if self.limits.usd is None:
            return None
        return max(self.limits.usd - self.spent.usd - (self.max_scene_usd or 0.0) * len(self.granted), 0.0)


def resume_budget(limits: SpendingLimits, logged: Mapping[str, ModelCost]) -> Budget:
    """Create the budget of a dataset from its earlier spending, by the name of the grant."""
    max_usd = max((spent.usd for spent in logged.values()), default=0.0)
    return Budget(limits, sum(logged.values(), NO_COST), max_usd or None)
