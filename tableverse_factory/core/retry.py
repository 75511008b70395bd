"""Retry policy for requests to servers: which failures are transient, and how long to wait before the next attempt."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

TRANSIENT_STATUSES = frozenset({408, 425, 429, 500, 502, 503, 504})
"""HTTP statuses that another attempt may turn into a success."""


class TransientError(Exception):
    """A request failed in a way that another attempt may heal; caught by the loop that makes the attempts.

    Attributes:
        wait_s: How long the server asks to wait, or None [s].
    """

    def __init__(self, message: str, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """Bounds on the attempts of one request.

    Attributes:
        attempts: Number of attempts in all.
        backoff_s: Wait before the second attempt; it doubles before each further one [s].
        max_backoff_s: Longest wait by backoff [s].
        max_asked_s: Longest wait that a server may ask for; a longer one ends the attempts [s].
    """

    attempts: int
    backoff_s: float
    max_backoff_s: float = 60.0
    max_asked_s: float = math.inf

    def next_wait(
        self, attempt: int, asked_s: float | None = None, left_s: float = math.inf, jitter: float = 1.0
    ) -> float | None:
        """Compute the wait after a failed attempt.

        Args:
            attempt: Number of the failed attempt, from 1.
            asked_s: Wait that the server asks for; it replaces the backoff [s].
            left_s: Time left for waits and attempts [s].
            jitter: Factor on the backoff, to spread clients.

        Returns:
            Seconds to wait, or None when no further attempt is due.
        """
        if attempt >= self.attempts or (asked_s is not None and asked_s > self.max_asked_s):
            return None
        wait_s = min(self.backoff_s * 2.0 ** (attempt - 1), self.max_backoff_s) * jitter if asked_s is None else asked_s
        return wait_s if wait_s < left_s else None


def parse_retry_after(value: str | None, now: datetime | None = None) -> float | None:
    """Parse a Retry-After header, in seconds or as a date; None if there is none or it is malformed [s].

    Args:
        value: Header as the server sent it, untrusted.
        now: Time to count from, the clock's by default.
    """
    try:
        if value is None or value.strip().isdecimal():
            return None if value is None else float(value)
        return max(0.0, (parsedate_to_datetime(value) - (now or datetime.now(UTC))).total_seconds())
    except (ValueError, TypeError, OverflowError):
        return None
