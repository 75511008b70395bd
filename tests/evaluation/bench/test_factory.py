"""The benches of the factory and of queries measure what they say, on known answers."""

import math
import sys

import numpy as np
import pytest

from schemas.config import Config
from schemas.manifest import SceneKind
from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.shards import check_exported
from tableverse_factory.evaluation.bench import factory, noop_pipeline
from tableverse_factory.evaluation.bench.factory import NOOP, FactoryRun, _run_once, compare_runs
from tableverse_factory.evaluation.bench.process_meter import measure_command
from tableverse_factory.evaluation.bench.query import OBJECTS_PER_SCENE, bench_query, write_query_dataset
from tableverse_factory.pipeline import STAGES

pytestmark = pytest.mark.heavy


def _measured(
    what: str, workers: int, scenes: int, once_s: float, each_ms: float, steady_rate: float = 1.0
) -> FactoryRun:
    """A run in which every scene costs the same, after something that is done once; one CPU works."""
    seconds = once_s + each_ms * scenes / 1e3
    return FactoryRun(
        *(what, workers, scenes, seconds, 10.0, int(10 * steady_rate), each_ms, 1.0),
        *({"driver": 1e3 * seconds / scenes}, 90.0, 0.0),
    )


def test_the_line_that_does_nothing_has_the_stages_and_pools_of_the_real_one():
    assert [(s.name, s.pool) for s in noop_pipeline.NOOP_PIPELINES[SceneKind.CAPTURE]] == [
        (s.name, s.pool) for s in STAGES
    ]
    assert [(s.name, s.pool) for s in noop_pipeline.BURNING_PIPELINES[SceneKind.CAPTURE]] == [
        (s.name, s.pool) for s in STAGES
    ]
    check_exported(noop_pipeline.make_minimal_scene("a"), "a")


def test_ratios_leave_out_what_is_done_once():
    sizes = (100, 1000, 10_000)
    runs = [_measured("ray", 2, n, 20.0, 4.0) for n in sizes]
    runs += [_measured("ray", 1, n, 15.0, 3.0) for n in sizes[:2]] + [
        _measured("local", 1, n, 1.0, 1.25) for n in sizes[:2]
    ]
    runs += [_measured("burning", w, 50, 1.0, 1.0, steady_rate=rate) for w, rate in ((1, 7.0), (2, 13.3))]
    runs += [_measured("ray data", 2, n, 30.0, 6.0) for n in sizes]
    found = compare_runs(runs)
    assert found.linear == pytest.approx(1.0)
    assert found.ray_ms == pytest.approx(1.75)
    assert found.speed_up == pytest.approx(1.9)
    assert found.to_ray_data == pytest.approx(1.5)
    assert compare_runs([*runs[:2], _measured("ray", 2, 10_000, 20.0, 8.0)]).linear == pytest.approx(
        (80_000 - 4_000) / 9_000 / 4
    )
    assert all(math.isnan(value) for value in (compare_runs(runs[:2]).ray_ms, compare_runs(runs[:2]).speed_up))


@pytest.mark.slow  # figures of a bench
def test_a_build_is_measured_from_outside(tmp_path):
    run = _run_once("local", 1, 70, NOOP, tmp_path, payload=0)
    assert run.scenes == 70
    assert run.working_s > 0.0
    assert {"driver", "sandboxes"} <= set(run.cpu_ms)
    assert 20.0 < run.peak_mb < 1000.0
    assert not (tmp_path / "out").exists()


@pytest.mark.slow  # starts Ray, for figures of a bench alone
def test_a_payload_is_in_the_dataset_and_passes_by_the_driver(tmp_path):
    payload, n = 1_000_000, 70  # more than are handed over at once
    run = _run_once("ray", 1, n, NOOP, tmp_path, payload)
    assert run.scenes == n
    assert 0.5 < run.driver_kb < 20.0, "1 MB each, and a few thousand bytes"
    row = factory._make_row(0, payload)
    scene = noop_pipeline.observe_payload(row, Config(), np.random.default_rng(0)).value
    files = noop_pipeline.export_minimal(scene).value.files
    assert sum(len(data) for name, data in files if name.startswith("assets/")) == payload


def test_the_meter_counts_the_cpu_of_children_and_says_what_failed():
    burn = "import time\nwhile time.process_time() < 1.5: pass"
    child = f"subprocess.run([sys.executable, '-c', {burn!r}])"
    parent = f"import subprocess, sys, time; {child}; print(time.monotonic(), 1)"
    seen = measure_command([sys.executable, "-c", parent], {}, lambda _: "below")
    assert 0.8 < seen.cpu_s["below"] < 2.0
    assert seen.cpu_s["driver"] < 1.0
    assert seen.lines[0][1] == 1
    with pytest.raises(BuildError, match=r"ended with 1[\s\S]*no such thing"):
        measure_command([sys.executable, "-c", "raise SystemExit('no such thing')"], {}, str)


@pytest.mark.slow  # figures of a bench
def test_the_dataset_written_for_queries_is_one_and_is_measured(tmp_path):
    assert write_query_dataset(tmp_path / "out", 130, 64) == 3
    write_query_dataset(tmp_path / "again", 130, 64)
    dataset = open_dataset(tmp_path / "out")
    assert dataset.objects.to_table().equals(open_dataset(tmp_path / "again").objects.to_table())
    assert {dataset.scene(i).model().nbody for i in dataset.scenes.to_table()["scene_id"].to_pylist()} == {2}
    times = bench_query(tmp_path / "out", "small")
    assert (times.shards, times.scenes, times.objects) == (3, 130, 130 * OBJECTS_PER_SCENE)
    label = dataset.objects.head(1)["label"][0].as_py()
    rows = dataset.objects.to_table(columns=["label", "label_confidence"]).to_pylist()
    assert times.found == sum(row["label"] == label and row["label_confidence"] >= 0.9 for row in rows)
