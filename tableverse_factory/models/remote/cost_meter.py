"""What questions to models cost, counted where they are asked: stages hand nothing on."""

from collections.abc import Callable
from dataclasses import replace

from schemas.outcome import NOTHING, UNLIMITED, Allowance, Spent
from tableverse_factory.core.errors import BudgetSpentError


def _kept_nowhere(_spent: Spent) -> None:
    pass


class Meter:
    """Counts from `reset` to `reset`: of one stage on one scene.

    Attributes:
        cost: What the answers cost when they were first given, also those that now come from the cache.
        paid: What was spent since the last `reset`.
    """

    def __init__(self, note: Callable[[Spent], None] = _kept_nowhere) -> None:
        """Makes a meter without a limit.

        Args:
            note: Told of everything that is spent: of a request before it is sent, of tokens when they are counted.
        """
        self._note = note
        self._left = UNLIMITED
        self.cost, self.paid = NOTHING, NOTHING

    def allow(self, allowance: Allowance) -> None:
        """From now on no more than this may be spent."""
        self._left = allowance

    def reset(self) -> None:
        """Begins at nothing; what is left of the allowance stays."""
        self.cost, self.paid = NOTHING, NOTHING

    def remember(self, cost: Spent) -> None:
        """An answer came from the cache."""
        self.cost += cost

    def check(self) -> None:
        """Says whether a request may be sent.

        Raises:
            BudgetSpentError: if none may be.
        """
        calls, usd = self._left.calls, self._left.usd
        if (calls is not None and calls <= 0) or (usd is not None and usd <= 0.0):
            raise BudgetSpentError("the budget is spent")

    def ask(self) -> None:
        """A request is about to be sent.

        Raises:
            BudgetSpentError: if none may be.
        """
        self.check()
        self._spend(Spent(calls=1))

    def answered(self, tokens: Spent) -> None:
        """The server counted this for a request."""
        self._spend(tokens)

    def _spend(self, spent: Spent) -> None:
        self._note(spent)
        self.cost += spent
        self.paid += spent
        calls, usd = self._left.calls, self._left.usd
        self._left = replace(
            self._left,
            calls=None if calls is None else calls - spent.calls,
            usd=None if usd is None else usd - spent.usd,
        )
