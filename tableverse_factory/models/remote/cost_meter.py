"""Meter of the cost of requests to models, within an allowance."""

from collections.abc import Callable
from dataclasses import replace

from schemas.outcome import NO_COST, UNLIMITED, Allowance, ModelCost
from tableverse_factory.core.errors import BudgetSpentError


class Meter:
    """Meter of one stage on one scene, from `reset` to `reset`, at first without a limit.

    Attributes:
        cost: Cost of the answers when they were first given, including those from the cache.
        paid: Cost of the requests since the last `reset`.
    """

    def __init__(self, note: Callable[[ModelCost], None] = lambda _spent: None) -> None:
        """Create a meter; `note` gets every cost: of a request before it is sent, of tokens when they are counted."""
        self._note = note
        self._left = UNLIMITED
        self.cost, self.paid = NO_COST, NO_COST

    def allow(self, allowance: Allowance) -> None:
        """Set how much may be spent from now on."""
        self._left = allowance

    def reset(self) -> None:
        """Set the counts to zero; the rest of the allowance stays."""
        self.cost, self.paid = NO_COST, NO_COST

    def add_cached(self, cost: ModelCost) -> None:
        """Count an answer from the cache."""
        self.cost += cost

    def check(self) -> None:
        """Raise BudgetSpentError if the allowance is spent."""
        calls, usd = self._left.calls, self._left.usd
        if (calls is not None and calls <= 0) or (usd is not None and usd <= 0.0):
            raise BudgetSpentError("the budget is spent")

    def add_request(self) -> None:
        """Count a request that is about to be sent; BudgetSpentError if the allowance is spent."""
        self.check()
        self._spend(ModelCost(calls=1))

    def add_tokens(self, tokens: ModelCost) -> None:
        """Count the tokens that the server reports for a request."""
        self._spend(tokens)

    def _spend(self, spent: ModelCost) -> None:
        self._note(spent)
        self.cost += spent
        self.paid += spent
        calls, usd = self._left.calls, self._left.usd
        left_usd = None if usd is None else usd - spent.usd
        self._left = replace(self._left, calls=None if calls is None else calls - spent.calls, usd=left_usd)
