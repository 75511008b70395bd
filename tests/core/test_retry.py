"""Retry policy: bounded attempts, doubling waits, and what servers ask for."""

import math
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.core.retry import RetryPolicy, parse_retry_after

POLICY = RetryPolicy(attempts=5, backoff_s=0.5, max_backoff_s=3.0, max_asked_s=60.0)
NOON = datetime(2026, 1, 1, 12, 0, tzinfo=UTC)


def test_waits_double_up_to_the_longest_and_end_with_the_attempts() -> None:
    assert [POLICY.next_wait(attempt) for attempt in range(1, 7)] == [0.5, 1.0, 2.0, 3.0, None, None]


def test_jitter_spreads_the_backoff_but_not_what_a_server_asks_for() -> None:
    assert POLICY.next_wait(2, jitter=1.5) == 1.5
    assert POLICY.next_wait(2, asked_s=7.0, jitter=1.5) == 7.0


def test_a_server_may_ask_for_no_more_than_is_allowed() -> None:
    assert POLICY.next_wait(1, asked_s=60.0) == 60.0
    assert POLICY.next_wait(1, asked_s=60.1) is None
    assert POLICY.next_wait(5, asked_s=0.0) is None


@given(st.integers(1, 10), st.none() | st.floats(0.0, math.inf), st.floats(0.0, 100.0))
def test_a_wait_always_fits_into_the_time_that_is_left(attempt: int, asked_s: float | None, left_s: float) -> None:
    wait_s = POLICY.next_wait(attempt, asked_s, left_s)
    assert wait_s is None or (0.0 <= wait_s < left_s and attempt < POLICY.attempts)


@pytest.mark.parametrize(
    ("value", "wait_s"),
    [
        ("3", 3.0),
        (" 3 ", 3.0),
        ("Thu, 01 Jan 2026 12:00:09 GMT", 9.0),
        ("Thu, 01 Jan 2026 11:00:00 GMT", 0.0),
        ("9" * 400, math.inf),
        *((broken, None) for broken in (None, "", "²", "soon", "-1", "1.5", "Thu, 99 Jan 2026 12:00:09 GMT")),
    ],
)
def test_retry_after_is_seconds_or_a_date(value: str | None, wait_s: float | None) -> None:
    assert parse_retry_after(value, NOON) == wait_s
