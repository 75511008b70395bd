"""Retry policy for requests to servers: which failures are transient, and how long to wait before the next attempt."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

TRANSIENT_STATUSES = frozenset({408, 425, 429, 500, 502, 503, 504})
"""HTTP statuses that another attempt may turn into a success."""


class TransientError(Exception):
    """A request failed in a way that another attempt may heal; `wait_s` is what the server asks to wait [s]."""

    def __init__(self, message: str, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True)
class RetryPolicy:
    """Bounds on the attempts of one request.

    Attributes:
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
        """Compute the wait after the failed attempt number `attempt`, from 1 [s]; None when no other is due.

        The wait `asked_s` of the server replaces the backoff; `jitter` scales it; `left_s` remains for all.
        """
        if attempt >= self.attempts or (asked_s is not None and asked_s > self.max_asked_s):
            return None
        wait_s = min(self.backoff_s * 2.0 ** (attempt - 1), self.max_backoff_s) * jitter if asked_s is None else asked_s
        return wait_s if wait_s < left_s else None


def parse_retry_after(value: str | None, now: datetime | None = None) -> float | None:
    """Parse an untrusted Retry-After header, in seconds or as a date; None if it is missing or malformed [s]."""
    try:
        if value is None or value.strip().isdecimal():
            return None if value is None else float(value)
        return max(0.0, (parsedate_to_datetime(value) - (now or datetime.now(UTC))).total_seconds())
    except (ValueError, TypeError, OverflowError):
        return None
