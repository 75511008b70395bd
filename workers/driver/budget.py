"""How much a build may still spend on questions to models: granted before a scene is sent, settled when it is back."""

import math
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.config import AskedSection, Config
from schemas.outcome import NOTHING, Allowance, Spent
from tableverse_factory.models.remote.client import MOST_CALLS
from tableverse_factory.stage import Stage


@dataclass(frozen=True, slots=True)
class SpendingLimits:
    """What a dataset may cost, over all runs; None for no limit.

    Attributes:
        calls: Requests to models.
        usd: By the prices of the configuration [USD].
    """

    calls: int | None = None
    usd: float | None = None


NO_LIMITS = SpendingLimits()


def calls_model(stage: Stage, config: Config) -> bool:
    """Whether a stage asks a model behind an address that may want money for it."""
    section = getattr(config, stage.section)
    return isinstance(section, AskedSection) and bool(section.asked)


@dataclass(slots=True)
class Budget:
    """The arithmetic of what is left.

    Requests are granted before they are sent, so they never exceed their limit. What one will cost nobody knows: each
    scene under way counts as the dearest so far, and while no price is known, one goes alone.

    Attributes:
        limits: Of the dataset.
        spent: Of the dataset so far, by scenes that are back.
        dearest_usd: Most that one scene's way through its stages has cost [USD]; None while no answer had a price.
        granted: What scenes under way may spend, by rank.
    """

    limits: SpendingLimits
    spent: Spent
    dearest_usd: float | None = None
    granted: dict[int, Allowance] = field(default_factory=dict)
    _run: str = field(default_factory=lambda: secrets.token_hex(4))
    _count: int = 0

    @property
    def is_spent(self) -> bool:
        """Whether nothing is left, whatever comes back from under way."""
        calls, usd = self.limits.calls, self.limits.usd
        return (calls is not None and self.spent.calls >= calls) or (usd is not None and self.spent.usd >= usd)

    @property
    def room(self) -> float:
        """How many scenes that ask may begin now. One alone always may: its answers may be in the cache."""
        calls, usd = self._calls_left(), self._usd_left()
        by_calls = math.inf if calls is None else math.ceil(calls / MOST_CALLS)
        if usd is None:
            by_usd = math.inf
        elif usd <= 0.0 or self.dearest_usd is None:
            by_usd = 0
        else:
            by_usd = math.ceil(usd / self.dearest_usd) if self.dearest_usd else math.inf
        return max(min(by_calls, by_usd), 0 if self.granted else 1)

    def grant(self, rank: int) -> Allowance:
        """What a scene may spend until it is back, under a name of its own among all runs."""
        calls, usd = self._calls_left(), self._usd_left()
        self._count += 1
        self.granted[rank] = Allowance(
            None if calls is None else min(MOST_CALLS, calls), usd, f"{self._run}-{self._count}"
        )
        return self.granted[rank]

    def settle(self, rank: int, paid: Spent, cost: Spent = NOTHING) -> None:
        """A scene is back.

        Args:
            rank: Which.
            paid: What it spent.
            cost: What the answers that it got cost when they were first given: kept ones tell the price, too.
        """
        del self.granted[rank]
        self.spent += paid
        usd = max(paid.usd, cost.usd)
        if usd > 0.0 or cost.calls:
            self.dearest_usd = max(self.dearest_usd or 0.0, usd)

    def _calls_left(self) -> int | None:
        if self.limits.calls is None:
            return None
        under_way = sum(allowance.calls or 0 for allowance in self.granted.values())
        return max(self.limits.calls - self.spent.calls - under_way, 0)

    def _usd_left(self) -> float | None:
        if self.limits.usd is None:
            return None
        return max(self.limits.usd - self.spent.usd - (self.dearest_usd or 0.0) * len(self.granted), 0.0)


def budget_of(limits: SpendingLimits, written_down: Mapping[str, Spent]) -> Budget:
    """The budget of a dataset on which this was spent before, by the name of the grant."""
    dearest = max((spent.usd for spent in written_down.values()), default=0.0)
    return Budget(limits, sum(written_down.values(), NOTHING), dearest or None)
