"""How much a build may still spend on questions to models: granted before a scene is sent, settled when it is back."""

import math
from dataclasses import dataclass, field

from schemas.config import AskedSection, Config
from schemas.outcome import UNLIMITED, Allowance, Spent
from tableverse_factory.models.client import MOST_CALLS
from tableverse_factory.stage import Stage


@dataclass(frozen=True, slots=True)
class Limits:
    """What a dataset may cost, over all runs; None for no limit.

    Attributes:
        calls: Requests to models.
        usd: By the prices of the configuration [USD].
    """

    calls: int | None = None
    usd: float | None = None


NO_LIMITS = Limits()


def asks(stage: Stage, config: Config) -> bool:
    """Whether a stage asks a model behind an address that may want money for it."""
    section = getattr(config, stage.section)
    return isinstance(section, AskedSection) and bool(section.asked)


@dataclass(slots=True)
class Budget:
    """The arithmetic of what is left.

    Requests are granted before they are sent, so they never exceed their limit. What one will cost nobody knows: each
    scene under way counts as the dearest so far.

    Attributes:
        limits: Of the dataset.
        spent: Of the dataset so far, those scenes apart that are under way.
        granted: Requests that scenes under way may send, by rank.
        dearest_usd: Most that one scene's way through its stages has cost in this run [USD].
    """

    limits: Limits
    spent: Spent
    granted: dict[int, int] = field(default_factory=dict)
    dearest_usd: float = 0.0

    @property
    def is_spent(self) -> bool:
        """Whether nothing is left, whatever comes back from under way."""
        calls, usd = self.limits.calls, self.limits.usd
        return (calls is not None and self.spent.calls >= calls) or (usd is not None and self.spent.usd >= usd)

    @property
    def room(self) -> float:
        """How many scenes that ask may begin now. One alone always may: its answers may be in the cache."""
        calls, usd = self._calls_left(), self._usd_left()
        by_calls = math.inf if calls is None else math.ceil(max(calls, 0) / MOST_CALLS)
        by_usd = math.inf if usd is None else 0 if usd <= 0.0 else math.inf
        if usd is not None and usd > 0.0 and self.dearest_usd > 0.0:
            by_usd = math.ceil(usd / self.dearest_usd)
        return max(min(by_calls, by_usd), 0 if self.granted else 1)

    def grant(self, rank: int) -> Allowance:
        """What a scene may spend until it is back."""
        if self.limits == NO_LIMITS:
            self.granted[rank] = 0
            return UNLIMITED
        calls, usd = self._calls_left(), self._usd_left()
        mine = None if calls is None else min(MOST_CALLS, max(calls, 0))
        self.granted[rank] = mine or 0
        return Allowance(mine, None if usd is None else max(usd, 0.0))

    def settle(self, rank: int, paid: Spent) -> None:
        """A scene is back."""
        self.granted.pop(rank, None)
        self.spent += paid
        self.dearest_usd = max(self.dearest_usd, paid.usd)

    def _calls_left(self) -> int | None:
        if self.limits.calls is None:
            return None
        return self.limits.calls - self.spent.calls - sum(self.granted.values())

    def _usd_left(self) -> float | None:
        if self.limits.usd is None:
            return None
        return self.limits.usd - self.spent.usd - self.dearest_usd * len(self.granted)
