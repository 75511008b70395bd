"""What may be spent: granted before it is spent, written down as it is, and never more than that."""

import resource
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import Config, CurateConfig, PerceiveConfig, RemoteModelSection
from schemas.outcome import NO_COST, UNLIMITED, Allowance, ModelCost
from tableverse_factory.core.errors import BudgetSpentError, ModelAccessError
from tableverse_factory.models.remote.cost_meter import Meter
from tableverse_factory.models.remote.endpoint import MOST_CALLS
from tableverse_factory.pipeline import PIPELINES
from workers.driver.budget import NO_LIMITS, Budget, SpendingLimits, calls_model, resume_budget
from workers.state.cost_log import CostLog, sum_costs, sum_costs_by_grant


@settings(max_examples=60)
@given(
    limit=st.integers(0, 60),
    wishes=st.lists(st.tuples(st.integers(0, 15), st.integers(0, 3)), max_size=60),
    workers=st.integers(1, 8),
)
def test_requests_never_exceed_their_limit_whatever_scenes_wish(limit, wishes, workers):
    budget, sent, under_way = Budget(SpendingLimits(calls=limit), NO_COST), 0, {}
    for rank, (wish, back) in enumerate(wishes):
        if len(under_way) < workers and budget.room > 0:
            under_way[rank] = min(wish, budget.grant(rank).calls)
            sent += under_way[rank]
        for done in list(under_way)[:back]:
            budget.settle(done, ModelCost(calls=under_way.pop(done)))
    assert sent <= limit
    for done in under_way:
        budget.settle(done, ModelCost(calls=under_way[done]))
    assert budget.spent.calls == sent
    assert budget.is_spent == (sent >= limit)
    assert budget.room >= 1, "one alone may always begin: its answers may be in the cache"


@settings(max_examples=40)
@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=50), st.integers(1, 8), st.floats(0.0, 5.0))
def test_money_is_exceeded_by_no_more_than_what_was_under_way(prices, workers, limit):
    budget, under_way = Budget(SpendingLimits(usd=limit), NO_COST), {}
    for rank, price in enumerate(prices):
        while budget.room < 1 or len(under_way) == workers:
            done = next(iter(under_way))
            budget.settle(done, ModelCost(1, usd=under_way.pop(done)))
        allowance = budget.grant(rank)
        under_way[rank] = price if allowance.usd > 0.0 else 0.0
    for rank, price in under_way.items():
        budget.settle(rank, ModelCost(1, usd=price))
    assert budget.spent.usd <= limit + workers * max(prices)


def test_without_a_limit_everything_may_begin():
    budget = Budget(NO_LIMITS, ModelCost(calls=10**9, usd=1e9))
    assert not budget.grant(0).is_limited
    assert budget.room > 10**9
    assert not budget.is_spent


def test_the_stages_that_may_want_money():
    where = {"base_url": "http://localhost:1/v1", "model": "m"}
    both = Config(
        perceive=PerceiveConfig(detector="openai", **where), curate=CurateConfig(judge="gemini", model="m", key_env="K")
    )
    for line in PIPELINES.values():
        assert not any(calls_model(stage, Config()) for stage in line)
        asking = [stage.name for stage in line if calls_model(stage, both)]
        assert asking == [stage.name for stage in line if stage.name in ("perceive", "curate")]
    assert all(isinstance(getattr(both, name), RemoteModelSection) for name in ("perceive", "curate"))


def test_a_meter_counts_what_answers_cost_and_what_was_spent_apart():
    noted = []
    meter = Meter(noted.append)
    meter.allow(Allowance(calls=2, usd=0.5))
    meter.add_cached(ModelCost(1, 900, 40, 0.25))
    assert (meter.cost, meter.paid) == (ModelCost(1, 900, 40, 0.25), NO_COST)
    meter.add_request()
    meter.add_tokens(ModelCost(0, 10, 5, 0.5))
    assert meter.cost == ModelCost(2, 910, 45, 0.75)
    assert meter.paid == sum(noted, NO_COST) == ModelCost(1, 10, 5, 0.5)
    with pytest.raises(BudgetSpentError):  # a request is left, but no money
        meter.add_request()
    meter.reset()
    with pytest.raises(BudgetSpentError):
        meter.add_request()
    meter.allow(UNLIMITED)
    for _ in range(MOST_CALLS):
        meter.add_request()


def test_what_processes_wrote_down_adds_up_and_an_entry_that_was_cut_off_counts_for_nothing(tmp_path):
    assert sum_costs(tmp_path) == NO_COST
    first, second = CostLog(tmp_path), CostLog(tmp_path)
    assert not list(tmp_path.iterdir()), "nothing is made until something is spent"
    for log, grant in ((first, "a-1"), (second, "a-2"), (first, "a-3")):
        log.grant = grant
        log.add(ModelCost(calls=1))
        log.add(ModelCost(0, 900, 40, 0.1 + 0.2))
    assert sum_costs(tmp_path) == ModelCost(3, 2700, 120, 3 * (0.1 + 0.2))
    assert sum_costs_by_grant(tmp_path) == dict.fromkeys(("a-1", "a-2", "a-3"), ModelCost(1, 900, 40, 0.1 + 0.2))
    for path in (tmp_path / ".spent").iterdir():
        path.write_bytes(path.read_bytes() + b"\na-3_1_0_0_0.0")
    first.add(ModelCost(calls=1))
    assert sum_costs(tmp_path).calls == 4


def test_an_entry_that_the_disk_takes_in_part_is_refused_and_spoils_no_other(tmp_path):
    log, accepted = CostLog(tmp_path), 0
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20, before[1]))  # python ignores SIGXFSZ
        for _ in range(3):
            with suppress(ModelAccessError):
                log.add(ModelCost(calls=1))
                accepted += 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert accepted == 1
    log.add(ModelCost(calls=1))
    assert sum_costs(tmp_path).calls == 2


def test_nothing_is_spent_that_cannot_be_written_down(tmp_path):
    (tmp_path / ".spent").write_text("a file in the way")
    meter = Meter(CostLog(tmp_path).add)
    with pytest.raises(ModelAccessError, match="what is spent cannot be written down in"):
        meter.add_request()
    assert meter.paid == NO_COST


def test_one_scene_goes_alone_until_a_price_is_known_and_another_run_knows_it():
    budget = Budget(SpendingLimits(usd=1.0), NO_COST)
    assert budget.room == 1
    assert budget.grant(0).usd == 1.0
    assert budget.room == 0
    budget.settle(0, ModelCost(calls=3))  # the server was busy: that says nothing of its price
    assert budget.room == 1
    budget.grant(1)
    budget.settle(1, NO_COST, cost=ModelCost(1, 900, 40, 0.2))  # an answer from the cache
    assert budget.room == 5
    resumed = resume_budget(
        SpendingLimits(usd=1.0), {"a-1": ModelCost(2, 1800, 80, 0.375), "a-2": ModelCost(1, 900, 40, 0.125)}
    )
    assert (resumed.spent.usd, resumed.room) == (0.5, 2)
    uncounted = Budget(SpendingLimits(usd=1.0), NO_COST)
    uncounted.grant(0)
    uncounted.settle(0, ModelCost(calls=1), cost=ModelCost(calls=1))
    assert uncounted.room > 10**9, "a server that counts no tokens holds nobody up"


def test_what_lost_scenes_spent_is_counted_once_and_not_that_of_scenes_under_way(tmp_path):
    """A scene's worker is lost while others are under way, whose entries are written down, too."""
    budget, log = Budget(SpendingLimits(calls=100), NO_COST), CostLog(tmp_path)
    for rank in range(3):
        log.grant = budget.grant(rank).name
        for _ in range(5):
            log.add(ModelCost(calls=1))
    budget.settle(2, sum_costs_by_grant(tmp_path)[budget.granted[2].name])
    for rank in (0, 1):
        budget.settle(rank, ModelCost(calls=5))
    assert budget.spent == sum_costs(tmp_path) == ModelCost(calls=15)
