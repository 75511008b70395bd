"""The arithmetic of estimates: laws, and intervals that hold the truth on timings whose truth is known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.pools import Pools, PoolSpec
from tableverse_factory.core.errors import BuildError, ConfigError
from tableverse_factory.dataset.cost_estimate import (
    MIN_SCENES,
    BuildSample,
    ClusterSize,
    StageTimes,
    bootstrap_total,
    estimate_cost,
    parse_amounts,
)

CPU_HOUR = 3600.0


def build(cpu=((10.0, 0.0), (20.0, 30.0)), wait=0.0, n=60, **more) -> BuildSample:
    """Scenes that alternate between the given CPU seconds of two stages; `wait` is wall time that is no CPU time."""
    first, second = (np.resize(np.array(values, float), n) for values in zip(*cpu, strict=True))
    stages = (
        StageTimes("perceive", "perception", first, first),
        StageTimes("curate", "curation", second, second + wait * (second > 0)),
    )
    return BuildSample(stages, **more)


def point(measured, scenes=1000, pools=None, cluster=None, prices=None):
    return estimate_cost(measured, scenes, pools or Pools(), cluster, prices or {})


def test_a_known_build():
    """Half of the scenes end after 10 s, the others take 50 s: 30 s a scene."""
    found = point(build(), scenes=1200, cluster=ClusterSize(cpus=4))
    assert found.cpu_hours.value == pytest.approx(1200 * 30.0 / CPU_HOUR)
    assert found.wall_hours.value == pytest.approx(1200 * 30.0 / CPU_HOUR / 4)
    assert found.gpu_hours.value == 0.0
    assert found.waiting_share == 0.0
    cpu, wall = found.stages["curate"]
    assert cpu.value == wall.value == pytest.approx(15.0)


@settings(max_examples=15)
@given(st.integers(1, 10**7), st.integers(1, 1000))
def test_everything_is_linear_in_the_scenes(scenes, factor):
    measured = build(storage={"tar": np.arange(60.0)}, input_tokens=np.arange(60.0), output_tokens=np.ones(60))
    prices = {"cpu_hour": 0.05, "input_mtok": 1.0, "gb_month": 0.02}
    cluster = ClusterSize(cpus=8)
    one, many = (point(measured, n, cluster=cluster, prices=prices) for n in (scenes, scenes * factor))
    for figure in ("cpu_hours", "cpu_hours_held", "wall_hours", "input_tokens", "output_tokens"):
        a, b = getattr(one, figure), getattr(many, figure)
        assert (b.value, b.low, b.high) == pytest.approx((a.value * factor, a.low * factor, a.high * factor))
    for name, cost in one.costs.items():
        assert many.costs[name].value == pytest.approx(cost.value * factor)
    assert many.storage["tar"].high == pytest.approx(one.storage["tar"].high * factor)


def test_half_the_cpus_take_twice_as_long():
    whole, half = (point(build(), cluster=ClusterSize(cpus=n)).wall_hours for n in (8, 4))
    assert half.value == pytest.approx(2 * whole.value)
    assert half.high == pytest.approx(2 * whole.high)


def test_more_cpus_do_not_help_a_build_that_lacks_gpus():
    pools = Pools(perception=PoolSpec(cpus=0.1, gpus=0.5))
    few, many = (point(build(), pools=pools, cluster=ClusterSize(n, gpus=1)) for n in (64, 640))
    assert few.wall_hours.value == many.wall_hours.value
    assert few.bottleneck == "the GPUs that actors hold"
    assert few.gpu_hours.value == pytest.approx(1000 * 15.0 * 0.5 / CPU_HOUR)
    with pytest.raises(BuildError, match="gpus=NUMBER"):
        point(build(), pools=pools, cluster=ClusterSize(64))


def test_who_waits_for_a_model_holds_little_and_a_bounded_pool_decides():
    waiting = build(wait=60.0)
    assert point(waiting, cluster=ClusterSize(8)).least_wall_hours == point(build(), cluster=ClusterSize(8)).wall_hours
    assert point(waiting).waiting_share == pytest.approx(30.0 / 60.0)
    whole = point(waiting, cluster=ClusterSize(8)).wall_hours
    light = point(waiting, pools=Pools(curation=PoolSpec(cpus=0.25)), cluster=ClusterSize(8)).wall_hours
    assert light.value < 0.7 * whole.value
    # never less than the CPU time itself takes
    tiny = point(waiting, pools=Pools(curation=PoolSpec(cpus=0.001)), cluster=ClusterSize(8))
    assert tiny.wall_hours.value == pytest.approx(tiny.cpu_hours.value / 8)
    assert tiny.bottleneck == "CPU time"
    bounded = point(waiting, pools=Pools(curation=PoolSpec(cpus=0.25, max=2)), cluster=ClusterSize(1000))
    assert bounded.bottleneck == "pool curation with at most 2 actors"
    assert bounded.wall_hours.value == pytest.approx(1000 * 45.0 / CPU_HOUR / 2)


def test_costs():
    measured = build(
        storage={"tar": np.full(60, 2e6), "tables": np.full(60, 1e6)},
        input_tokens=np.full(60, 3000.0),
        output_tokens=np.full(60, 500.0),
    )
    prices = {"cpu_hour": 0.05, "gpu_hour": 2.0, "input_mtok": 0.1, "output_mtok": 0.4, "gb_month": 0.02}
    held = point(measured, prices=prices).costs
    assert held["machines"].value == pytest.approx(1000 * 30 / CPU_HOUR * 0.05)
    assert held["models"].value == pytest.approx(3.0 * 0.1 + 0.5 * 0.4)
    assert held["storage per month"].value == pytest.approx(3.0 * 0.02)
    rented = point(measured, cluster=ClusterSize(10, gpus=1), prices=prices)
    assert rented.costs["machines"].value == pytest.approx(rented.wall_hours.value * (10 * 0.05 + 2.0))
    assert point(measured).costs == {}


@pytest.mark.heavy
@pytest.mark.parametrize("spread", [0.3, 1.0])
@pytest.mark.parametrize("n", [MIN_SCENES, 150])
def test_the_interval_holds_the_truth_nine_times_in_ten(spread, n):
    """Lognormal times of mean 10 s, 3 of 10 scenes dropped with a tenth of it: the truth is 7.3 s."""
    inside = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        times = 10.0 * rng.lognormal(-(spread**2) / 2, spread, n) * np.where(rng.random(n) < 0.3, 0.1, 1.0)
        found = bootstrap_total(times, 1)
        assert found.low <= found.value <= found.high
        inside += found.low <= 7.3 <= found.high
    assert inside >= 180, inside


@pytest.mark.heavy
def test_the_interval_narrows_and_is_the_same_every_time():
    times = np.random.default_rng(0).lognormal(size=6400)
    widths = [bootstrap_total(times[:n], 1).high - bootstrap_total(times[:n], 1).low for n in (100, 1600, 6400)]
    assert widths[0] / widths[2] == pytest.approx(8.0, rel=0.5)
    assert bootstrap_total(times, 5) == bootstrap_total(times, 5)


@settings(max_examples=50)
@given(st.lists(st.floats(0.0, 1e6), min_size=2, max_size=60))
def test_any_values_give_a_finite_interval_around_the_mean(values):
    found = bootstrap_total(np.array(values), 3)
    assert 0.0 <= found.low <= found.value <= found.high < math.inf


def test_a_rare_event_has_no_infinite_interval():
    values = np.zeros(40)
    values[7] = 100.0
    found = bootstrap_total(values, 1)
    assert found.low < found.value == 2.5 < found.high < 100.0


def test_too_few_scenes_are_refused():
    with pytest.raises(BuildError, match="49 scenes with timings are too few to say what 1000 will take"):
        point(build(n=49))
    with pytest.raises(BuildError, match="0 scenes"):
        point(BuildSample(()))


@pytest.mark.parametrize("text", ["cpus", "cpus=", "cpus=x", "cores=3", "cpus=-1", "cpus=inf", "=3", "cpus=nan"])
def test_amounts_that_are_none(text):
    with pytest.raises(ConfigError, match="cpus, gpus"):
        parse_amounts([text], ("cpus", "gpus"), "--cluster")


def test_amounts():
    assert parse_amounts(["cpus=64", "gpus=0.5"], ("cpus", "gpus"), "--cluster") == {"cpus": 64.0, "gpus": 0.5}
