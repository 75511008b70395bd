"""The soak test finds what it looks for: processes, growth, changed bytes, lost scenes; and passes a good build."""

import math
import subprocess
import sys
from array import array
from collections import Counter

import numpy as np
import psutil
import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.evaluation.bench import soak
from tableverse_factory.evaluation.bench.build_family import (
    ACTOR,
    DRIVER,
    MAX_SANDBOX_KILLS,
    SANDBOX,
    Member,
    choose_victim,
    list_family,
)
from tableverse_factory.evaluation.bench.process_memory import KindMemory, MemoryLog, compute_growth
from tableverse_factory.evaluation.bench.query import write_query_dataset

CHILD = "import time; time.sleep(60)"
PARENT = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {CHILD!r}, 'workers.sandbox.child'])"


def test_victims_are_of_all_kinds_and_the_sandboxes_of_an_actor_are_hit_twice():
    here, rng, hits = psutil.Process(), np.random.default_rng(0), Counter()
    actors = [Member(ACTOR, here, 1), Member(ACTOR, here, 1)]
    sandboxes = [Member(SANDBOX, here, 10), Member(SANDBOX, here, 11)]
    chosen = [choose_victim([Member(DRIVER, here, 0), *actors, *sandboxes], hits, rng) for _ in range(300)]
    kinds = Counter(victim.kind for victim in chosen)
    assert Counter(victim.parent for victim in chosen if victim.kind == SANDBOX) == {10: 2, 11: 2}
    assert kinds[SANDBOX] == 2 * MAX_SANDBOX_KILLS
    assert min(kinds[DRIVER], kinds[ACTOR]) > 100
    assert choose_victim(sandboxes, hits, rng) is None


@pytest.mark.heavy
def test_a_sandbox_is_found_below_its_driver_and_is_killed_once():
    driver = subprocess.Popen([sys.executable, "-c", PARENT])
    try:
        while len(family := list_family(driver.pid)) < 2:
            assert driver.poll() is None
        assert [(member.kind, member.parent) for member in family][1:] == [(SANDBOX, driver.pid)]
        assert family[1].kill()
        driver.wait(30)
        assert not family[1].kill()
        assert list_family(driver.pid) == []
    finally:
        driver.kill()


def test_growth_is_that_of_the_second_half_of_long_lives():
    at_s = array("d", range(1000))
    rising = array("d", [100.0 + 0.1 * t for t in at_s])
    assert compute_growth(at_s, rising) == pytest.approx(193.75 / 156.25 - 1, abs=0.01)
    assert compute_growth(at_s, array("d", [min(t, 400.0) + 50.0 for t in at_s])) == 0.0
    log = MemoryLog(min_life_s=500.0)
    for t in range(1000):
        log.add(DRIVER, (1, 0.0), t, 100.0)
        log.add(ACTOR, (2, 0.0), t, 100.0 + t)
        log.add(ACTOR, (2, 5.0), t, 100.0)
        log.add(SANDBOX, (3, 0.0), t / 10, 100.0 + t)
    actor, driver, sandbox = log.summarize()
    assert (actor.processes, actor.long_lived, actor.peak_mb) == (2, 2, 1099.0)
    assert driver.growth == 0.0
    assert sandbox.long_lived == 0
    assert math.isnan(sandbox.growth)
    assert [line.rsplit(" ", 1)[1] for line in soak.find_growth([actor, driver, sandbox])] == [ACTOR]
    assert soak.find_growth([KindMemory(DRIVER, 1, 90.0, 1, 0.09)]) == []


def test_changed_lost_and_new_files_are_named_and_timings_do_not_count(tmp_path):
    for name in ("scenes/a.parquet", "mjcf/a.tar", "timings/a.parquet", ".work/lock", "run.json"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(name)
    whole = soak.hash_dataset(tmp_path)
    assert sorted(whole) == ["mjcf/a.tar", "run.json", "scenes/a.parquet"]
    (tmp_path / "timings/a.parquet").write_text("other")
    assert soak.compare_digests(whole, soak.hash_dataset(tmp_path)) == []
    (tmp_path / "mjcf/a.tar").write_text("other")
    (tmp_path / "run.json").unlink()
    (tmp_path / "scenes/b.parquet").write_text("new")
    [line] = soak.compare_digests(whole, soak.hash_dataset(tmp_path))
    assert line.startswith("mjcf/a.tar, run.json, scenes/b.parquet:")


@pytest.mark.heavy
def test_lost_and_unknown_scenes_are_named(tmp_path):
    write_query_dataset(tmp_path / "out", 70, 64)
    ids = soak.open_dataset(tmp_path / "out").scenes.to_table()["scene_id"].to_pylist()
    assert soak.find_unaccounted(tmp_path / "out", ids) == []
    [line] = soak.find_unaccounted(tmp_path / "out", [*ids[1:], "lost"])
    assert line.startswith(f"lost, {ids[0]}:")


@pytest.mark.slow  # figures of a bench
@pytest.mark.heavy
def test_a_build_that_fails_by_itself_ends_the_test_with_its_own_words(tmp_path):
    plan = soak.SoakPlan(tmp_path, 3, 1, 1.0, 5.0, 0)
    with pytest.raises(BuildError, match=r"ended with 1[\s\S]*images.parquet does not exist"):
        soak._run_build(plan, tmp_path / "out", MemoryLog())


@pytest.mark.slow
def test_a_build_under_kills_is_accounted_for_verified_and_the_same(tmp_path):
    plan, lines = soak.SoakPlan(tmp_path / "soaked", 4, 2, 40.0, 6.0, 3), []
    report = soak.run_soak(plan, lines.append)
    assert report.problems == ()
    assert report.builds >= 1
    assert sum(report.kills.values()) == sum(line.startswith("killed: ") for line in lines) >= 1
    assert {kind.kind for kind in report.memory} == {ACTOR, DRIVER, SANDBOX}
    assert all(30.0 < kind.peak_mb < 2000.0 for kind in report.memory)
