"""The pace of a build, on simulated builds whose true end is known."""

import heapq

import numpy as np
import pytest

from workers.progress.eta import ProgressRate, estimate_remaining_calls
from workers.progress.tally import Tally

STAGES = ("manifest", "look", "cut", "fall", "pack")
MEAN_S = {"look": 1.0, "cut": 8.0, "fall": 2.0, "pack": 0.5}
DROPS = {"look": 0.3, "cut": 0.1, "fall": 0.05, "pack": 0.0}


def simulate(seed, scenes=400, workers=4, spread=1.0, start_s=0.0):
    """Runs a build of lognormal calls; yields the time and the tally twice a second, and at the end."""
    rng = np.random.default_rng(seed)
    tally = Tally(STAGES, total=scenes, before=0, shards=1)
    line = [(stage, MEAN_S[stage]) for stage in STAGES[1:]]
    waiting, running, todo, now, next_look = [], [], list(range(scenes)), start_s, 0.0
    while todo or waiting or running:
        while len(running) < workers and (waiting or todo):
            if waiting:
                position, scene = min(waiting, key=lambda item: (-item[0], item[1]))
                waiting.remove((position, scene))
                tally.queued[STAGES[position + 1]] -= 1
            else:
                position, scene = 0, todo.pop(0)
            stage, mean_s = line[position]
            took = mean_s * rng.lognormal(-(spread**2) / 2, spread)
            heapq.heappush(running, (now + took, scene, position, took))
            tally.running[stage] += 1
        until = running[0][0]
        while next_look < until:
            yield next_look, tally
            next_look += 0.5
        now, scene, position, took = heapq.heappop(running)
        stage = line[position][0]
        tally.running[stage] -= 1
        tally.record_call(stage, took, took)
        if rng.random() < DROPS[stage]:
            tally.ended[stage, "dropped"] += 1
        elif position + 1 == len(line):
            tally.ended[stage, "done"] += 1
        else:
            tally.passed[stage] += 1
            tally.queued[line[position + 1][0]] += 1
            waiting.append((position + 1, scene))
    yield now, tally


def told(seed, **options):
    """What was said when, and when the build ended."""
    pace, said, now = ProgressRate(), [], 0.0
    for now, tally in simulate(seed, **options):
        pace.update(now, tally)
        said.append((now, pace.estimate_left_s(now, tally)))
    return said, now


@pytest.mark.heavy
@pytest.mark.parametrize("start_s", [40.0, pytest.param(0.0, marks=pytest.mark.slow)])
def test_the_first_word_on_the_end_is_already_a_fair_one(start_s):
    ratios = []
    for seed in range(20):
        said, end = told(seed, start_s=start_s)
        at, left = next((at, left) for at, left in said if left is not None)
        assert at < 0.2 * end
        ratios.append(left / (end - at))
    assert 0.7 < np.median(ratios) < 1.4
    assert np.mean([0.4 < ratio < 2.5 for ratio in ratios]) >= 0.95, sorted(ratios)


@pytest.mark.heavy
def test_half_way_it_is_close():
    ratios = []
    for seed in range(15):
        said, end = told(seed)
        at, left = min((entry for entry in said if entry[1] is not None), key=lambda entry: abs(entry[0] - end / 2))
        ratios.append(left / (end - at))
    assert np.median(ratios) == pytest.approx(1.0, abs=0.12)
    assert all(0.6 < ratio < 1.6 for ratio in ratios), ratios


def test_it_says_nothing_before_every_stage_to_come_was_seen():
    pace = ProgressRate()
    for now, tally in simulate(1):
        pace.update(now, tally)
        if pace.estimate_left_s(now, tally) is not None:
            assert all(tally.wall[stage].count >= 3 for stage in STAGES[1:])
            break


def test_a_stall_is_seen_and_the_memory_stays_small():
    pace, tally = ProgressRate(), Tally(STAGES, total=10**6, before=0, shards=1)
    for second in range(5000):
        if second < 4000:
            tally.record_call("look", 1.0, 1.0)
            tally.passed["look"] += 1
        pace.update(float(second), tally)
    assert pace.idle_s(5000.0) == pytest.approx(1001.0)
    assert pace.calls_per_s(5000.0, tally, "look") == 0.0
    assert pace.estimate_left_s(5000.0, tally) is None
    assert len(pace._samples) <= 302


def test_rates_are_those_of_the_last_minute():
    pace, tally = ProgressRate(), Tally(STAGES, total=10**6, before=0, shards=1)
    for second in range(400):
        for _ in range(1 if second < 300 else 5):
            tally.record_call("pack", 0.1, 0.1)
            tally.ended["pack", "done"] += 1
        pace.update(float(second), tally)
    assert pace.scenes_per_s(399.0, tally) == pytest.approx(5.0)
    assert pace.calls_per_s(399.0, tally, "pack") == pytest.approx(5.0)
    assert pace.calls_per_s(399.0, tally, "look") is None


def test_calls_to_come_follow_the_drops():
    tally = Tally(STAGES, total=1000, before=0, shards=1)
    for stage, arrived, dropped in (("look", 100, 50), ("cut", 50, 10), ("fall", 40, 0)):
        tally.ended[stage, "dropped"], tally.passed[stage] = dropped, arrived - dropped
    tally.ended["pack", "done"] = 40
    assert estimate_remaining_calls(tally) == pytest.approx({"look": 900, "cut": 450, "fall": 360, "pack": 360})


def test_a_run_that_is_limited_has_less_to_come():
    tally = Tally(STAGES, total=1000, before=100, shards=1, target=300)
    tally.passed.update(look=100, cut=100, fall=100)
    tally.ended["pack", "done"] = 100
    assert estimate_remaining_calls(tally) == pytest.approx({"look": 100, "cut": 100, "fall": 100, "pack": 100})


def test_calls_to_come_of_a_mixed_manifest():
    """Half the scenes enter at `fall`; rejected rows never enter."""
    tally = Tally(STAGES, total=400, before=0, shards=1)
    tally.ended["manifest", "dropped"] = 100
    tally.passed.update(look=50, cut=50, fall=100)
    tally.ended["pack", "done"] = 100
    assert estimate_remaining_calls(tally) == pytest.approx({"look": 50, "cut": 50, "fall": 100, "pack": 100})


def test_before_anything_happened_nothing_is_said():
    tally = Tally(STAGES, total=10, before=3, shards=1)
    pace = ProgressRate()
    pace.update(0.0, tally)
    pace.update(100.0, tally)
    assert pace.estimate_left_s(100.0, tally) is None
    assert pace.scenes_per_s(100.0, tally) is None
    assert pace.idle_s(100.0) == pytest.approx(100.0)


def test_a_build_of_long_scenes_is_judged_by_a_longer_past():
    pace, tally = ProgressRate(), Tally(("manifest", "cut"), total=100, before=0, shards=1)
    for second in range(3000):
        if second % 200 == 0:
            tally.record_call("cut", 400.0, 400.0)
            tally.ended["cut", "done"] += 1
        pace.update(float(second), tally)
    assert pace.estimate_left_s(2999.0, tally) == pytest.approx(85 * 200.0, rel=0.25)
