"""What may be spent: granted before it is spent, written down as it is, and never more than that."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import AskedSection, Config, CurateConfig, PerceiveConfig
from schemas.outcome import NOTHING, UNLIMITED, Allowance, Spent
from tableverse_factory.errors import BudgetSpentError, ModelAccessError
from tableverse_factory.models.client import MOST_CALLS
from tableverse_factory.models.meter import Meter
from tableverse_factory.pipeline import LINES
from workers.budget import NO_LIMITS, Budget, Limits, asks
from workers.spending import SpendingLog, spent_so_far


@settings(max_examples=60)
@given(
    limit=st.integers(0, 60),
    wishes=st.lists(st.tuples(st.integers(0, 15), st.integers(0, 3)), max_size=60),
    workers=st.integers(1, 8),
)
def test_requests_never_exceed_their_limit_whatever_scenes_wish(limit, wishes, workers):
    budget, sent, under_way = Budget(Limits(calls=limit), NOTHING), 0, {}
    for rank, (wish, back) in enumerate(wishes):
        if len(under_way) < workers and budget.room > 0:
            under_way[rank] = min(wish, budget.grant(rank).calls)
            sent += under_way[rank]
        for done in list(under_way)[:back]:
            budget.settle(done, Spent(calls=under_way.pop(done)))
    assert sent <= limit
    for done in under_way:
        budget.settle(done, Spent(calls=under_way[done]))
    assert budget.spent.calls == sent
    assert budget.is_spent == (sent >= limit)
    assert budget.room >= 1, "one alone may always begin: its answers may be in the cache"


@settings(max_examples=40)
@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=50), st.integers(1, 8), st.floats(0.0, 5.0))
def test_money_is_exceeded_by_no_more_than_what_was_under_way(prices, workers, limit):
    budget, under_way = Budget(Limits(usd=limit), NOTHING), {}
    for rank, price in enumerate(prices):
        while budget.room < 1 or len(under_way) == workers:
            done = next(iter(under_way))
            budget.settle(done, Spent(1, usd=under_way.pop(done)))
        allowance = budget.grant(rank)
        under_way[rank] = price if allowance.usd > 0.0 else 0.0
    for rank, price in under_way.items():
        budget.settle(rank, Spent(1, usd=price))
    assert budget.spent.usd <= limit + workers * max(prices)


def test_without_a_limit_everything_may_begin():
    budget = Budget(NO_LIMITS, Spent(calls=10**9, usd=1e9))
    assert budget.grant(0) == UNLIMITED
    assert budget.room > 10**9
    assert not budget.is_spent


def test_the_stages_that_may_want_money():
    where = {"base_url": "http://localhost:1/v1", "model": "m"}
    both = Config(
        perceive=PerceiveConfig(detector="openai", **where), curate=CurateConfig(judge="gemini", model="m", key_env="K")
    )
    for line in LINES.values():
        assert not any(asks(stage, Config()) for stage in line)
        asking = [stage.name for stage in line if asks(stage, both)]
        assert asking == [stage.name for stage in line if stage.name in ("perceive", "curate")]
    assert all(isinstance(getattr(both, name), AskedSection) for name in ("perceive", "curate"))


def test_a_meter_counts_what_answers_cost_and_what_was_spent_apart():
    noted = []
    meter = Meter(noted.append)
    meter.allow(Allowance(calls=2, usd=0.5))
    meter.remember(Spent(1, 900, 40, 0.25))
    assert (meter.cost, meter.paid) == (Spent(1, 900, 40, 0.25), NOTHING)
    meter.ask()
    meter.answered(Spent(0, 10, 5, 0.5))
    assert meter.cost == Spent(2, 910, 45, 0.75)
    assert meter.paid == sum(noted, NOTHING) == Spent(1, 10, 5, 0.5)
    with pytest.raises(BudgetSpentError):  # a request is left, but no money
        meter.ask()
    meter.reset()
    with pytest.raises(BudgetSpentError):
        meter.ask()
    meter.allow(UNLIMITED)
    for _ in range(MOST_CALLS):
        meter.ask()


def test_what_processes_wrote_down_adds_up_and_a_torn_line_counts_for_nothing(tmp_path):
    assert spent_so_far(tmp_path) == NOTHING
    first, second = SpendingLog(tmp_path), SpendingLog(tmp_path)
    assert not list(tmp_path.iterdir()), "nothing is made until something is spent"
    for log in (first, second, first):
        log.add(Spent(calls=1))
        log.add(Spent(0, 900, 40, 0.1 + 0.2))
    assert spent_so_far(tmp_path) == Spent(3, 2700, 120, 3 * (0.1 + 0.2))
    path = next((tmp_path / "spent").iterdir())
    path.write_bytes(path.read_bytes() + b"1_0_0")
    assert spent_so_far(tmp_path).calls == 3


def test_nothing_is_spent_that_cannot_be_written_down(tmp_path):
    (tmp_path / "spent").write_text("a file in the way")
    meter = Meter(SpendingLog(tmp_path).add)
    with pytest.raises(ModelAccessError, match="what is spent cannot be written down in"):
        meter.ask()
    assert meter.paid == NOTHING
