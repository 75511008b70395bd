"""What a cluster's Prometheus would scrape from a real Ray while a build runs."""

import re
import time

import httpx
import pytest
import ray
import yaml
from prometheus_client.parser import text_string_to_metric_families

from tests.helpers.paths import ROOT
from workers.executors.ray_cluster import connect
from workers.progress import ray_metrics
from workers.progress.prometheus import LEFT, METRICS
from workers.progress.tally import Actors, Tally

SCRAPE = ROOT / "deploy" / "prometheus" / "prometheus.yml"
PATIENCE_S = 90.0


@pytest.fixture
def exporter():
    """Address of the metrics of a fresh Ray."""
    connect(None)
    try:
        (node,) = ray.nodes()
        yield f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics"
    finally:
        ray.shutdown()


def scrape(address: str) -> dict[tuple[str, ...], float]:
    """Samples by (name, labels of ours), renamed as the shipped scrape configuration does."""
    rename = yaml.safe_load(SCRAPE.read_text())["scrape_configs"][1]["metric_relabel_configs"][0]["regex"]
    text = httpx.get(address, timeout=10.0, trust_env=False).text
    own = {"dataset", "le", *(label for metric in METRICS for label in metric.labels)}
    return {
        (named.group(1), *(value for label, value in sorted(sample.labels.items()) if label in own)): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if (named := re.fullmatch(rename, sample.name))
    }


@pytest.mark.slow
def test_every_figure_arrives_under_the_dashboards_names(exporter, monkeypatch):
    monkeypatch.setattr(ray_metrics, "UPDATE_EVERY_S", 0.0)
    tally = Tally(
        ("manifest", "observe", "settle"), total=100, before=10, shards=7, bytes_committed=9, losses=1, restarts=1
    )
    tally.actors = {"perception": Actors(2, 4)}
    metrics = ray_metrics.RayMetrics("out")
    for wall_s in (0.02, 3.0, 9000.0):
        tally.record_call("observe", wall_s / 2, wall_s)
        tally.passed["observe"] += 1
        tally.ended["settle", "done"] += 1
        metrics.show(tally)

    until, found = time.monotonic() + PATIENCE_S, {}
    while ("tableverse_scenes_ended_total", "out", "settle", "done") not in found:
        assert time.monotonic() < until, sorted(found)
        time.sleep(2.0)
        found = scrape(exporter)
    assert found["tableverse_scenes_ended_total", "out", "settle", "done"] == 3.0
    assert found["tableverse_stage_passed_total", "out", "observe"] == 3.0
    assert found["tableverse_scenes_accounted", "out"] == 13.0
    assert found["tableverse_workers_alive", "out", "perception"] == 2.0
    assert found["tableverse_stage_wall_seconds_count", "out", "observe"] == 3.0
    assert found["tableverse_stage_wall_seconds_bucket", "out", "0.02", "observe"] == 1.0
    assert found["tableverse_stage_wall_seconds_bucket", "out", "5000.0", "observe"] == 2.0
    assert found["tableverse_stage_cpu_seconds_total", "out", "observe"] == pytest.approx(4501.51)
    names = {key[0] for key in found}
    for metric in METRICS:
        if metric is LEFT:
            continue  # unknown here, and Ray passes no NaN on
        assert metric.name in names or f"{metric.name}_bucket" in names
