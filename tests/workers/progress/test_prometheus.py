"""Figures for Prometheus, read back with Prometheus' own parser."""

import json
import math
import re
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from tableverse_factory.cli.main import main
from tableverse_factory.core.errors import InputError
from tests.helpers.paths import ROOT
from workers.progress.prometheus import METRICS, MetricsFile, collect_samples, dataset_name, prometheus_text
from workers.progress.tally import Actors, Durations, Tally

STAGES = ("manifest", "observe", "settle")


def busy() -> Tally:
    tally = Tally(STAGES, total=100, before=10, shards=7, committed=2, bytes_committed=12345, losses=3, restarts=2)
    for wall_s in (0.0004, 0.02, 0.02, 3.0, 9000.0):
        tally.record_call("observe", wall_s / 2, wall_s)
    tally.passed["observe"], tally.queued["settle"], tally.running["observe"] = 4, 3, 2
    tally.ended["observe", "dropped"], tally.ended["settle", "done"] = 1, 5
    tally.actors = {"perception": Actors(2, 4)}
    return tally


def families(text: str) -> dict[str, dict]:
    """Metric name -> (type, {(sample name, labels) -> value})."""
    found = {}
    for family in text_string_to_metric_families(text):
        samples = {(s.name, tuple(sorted(s.labels.items()))): s.value for s in family.samples}
        assert len(samples) == len(family.samples), "a sample twice"
        found[family.name] = {"type": family.type, "help": family.documentation, "samples": samples}
    return found


def test_what_prometheus_reads_is_what_the_tally_says():
    read = families(prometheus_text("out", collect_samples(busy(), 60.0, 1000.0, 990.0, running=True)))
    dataset = ("dataset", "out")
    assert read["tableverse_scenes_accounted"]["samples"] == {("tableverse_scenes_accounted", (dataset,)): 16.0}
    ended = read["tableverse_scenes_ended"]
    assert ended["type"] == "counter"
    key = ("tableverse_scenes_ended_total", (dataset, ("stage", "settle"), ("status", "done")))
    assert ended["samples"][key] == 5.0
    assert len(ended["samples"]) == 9
    alive = ("tableverse_workers_alive", (dataset, ("pool", "perception")))
    assert read["tableverse_workers_alive"]["samples"][alive] == 2.0
    assert {name for family in read.values() for name in family["help"].split("\n")} == {m.help for m in METRICS}
    assert {family["type"] for family in read.values()} == {"gauge", "counter", "histogram"}


def test_histograms_are_cumulative_and_add_up():
    read = families(prometheus_text("out", collect_samples(busy(), None, 0.0, 0.0, running=True)))
    wall = read["tableverse_stage_wall_seconds"]
    assert wall["type"] == "histogram"
    of_stage = {key: v for key, v in wall["samples"].items() if ("stage", "observe") in key[1]}
    buckets = sorted((float(dict(labels)["le"]), v) for (name, labels), v in of_stage.items() if "bucket" in name)
    counts = [count for _, count in buckets]
    assert counts == sorted(counts)
    assert buckets[0] == (0.001, 1.0)
    assert dict(buckets)[0.02] == 3.0
    assert dict(buckets)[5000.0] == 4.0
    assert buckets[-1] == (math.inf, 5.0)
    total = {name: v for (name, _), v in of_stage.items() if "bucket" not in name}
    assert total["tableverse_stage_wall_seconds_count"] == 5.0
    assert total["tableverse_stage_wall_seconds_sum"] == pytest.approx(9003.0404)


@pytest.mark.heavy
@given(st.text(max_size=30))
def test_any_name_of_a_dataset_survives(name):
    read = families(prometheus_text(name, collect_samples(busy(), None, 0.0, 0.0, running=False)))
    (key,) = read["tableverse_build_running"]["samples"]
    assert key[1] == (("dataset", name),)
    assert math.isnan(read["tableverse_build_left_seconds"]["samples"]["tableverse_build_left_seconds", key[1]])


@given(st.lists(st.floats(0.00101, 8000.0), min_size=1, max_size=200), st.floats(0.0, 1.0))
def test_quantiles_of_durations_are_right_within_a_bucket(values, q):
    durations = Durations()
    for value in values:
        durations.add(value)
    truth = sorted(values)[max(0, math.ceil(q * len(values)) - 1)]
    assert truth / 1.29 <= durations.quantile(q) <= truth * 1.29
    assert durations.count == len(values)
    assert durations.total_s == pytest.approx(sum(values))


def test_the_file_is_replaced_as_a_whole_and_seldom(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("workers.progress.prometheus.time.monotonic", lambda: now[0])
    path, tally = tmp_path / "textfile" / "tableverse.prom", busy()
    with MetricsFile(path, "out") as metrics:
        assert not path.exists()
        metrics.show(tally)
        first = path.stat().st_ino
        for _ in range(40):
            now[0] += 0.1
            metrics.show(tally)
        assert path.stat().st_ino == first
        now[0] += 1.1
        metrics.show(tally)
        assert path.stat().st_ino != first
        assert 'tableverse_build_running{dataset="out"} 1.0' in path.read_text()
        assert [entry for entry in path.parent.iterdir() if entry.suffix == ".prom"] == [path]
    assert 'tableverse_build_running{dataset="out"} 0.0' in path.read_text()
    assert list(path.parent.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_said_at_the_start(tmp_path):
    (tmp_path / "a_file").write_text("")
    with pytest.raises(InputError, match="a_file"), MetricsFile(tmp_path / "a_file" / "x.prom", "out"):
        pass


def test_an_address_is_no_file():
    with pytest.raises(InputError, match="on this machine"), MetricsFile(Path("s3://bucket/x.prom"), "out"):
        pass


@pytest.mark.heavy
def test_a_build_leaves_its_last_figures(tmp_path, monkeypatch):
    rows = [{"scene_id": f"s{i}", "kind": "capture", "uri": "/x", "rejected": "unreadable_color"} for i in range(70)]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    command = ["build", "m.parquet", "out", "--executor", "local", "--metrics", "tv.prom"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["tableverse", *command])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    read = families((tmp_path / "tv.prom").read_text())
    dropped = (("dataset", "out"), ("stage", "manifest"), ("status", "dropped"))
    assert read["tableverse_scenes_ended"]["samples"]["tableverse_scenes_ended_total", dropped] == 70.0
    assert read["tableverse_build_running"]["samples"]["tableverse_build_running", dropped[:1]] == 0.0
    assert read["tableverse_shards_committed"]["samples"]["tableverse_shards_committed", dropped[:1]] == 2.0
    assert read["tableverse_committed_bytes"]["samples"]["tableverse_committed_bytes_total", dropped[:1]] > 0.0


def test_a_disk_that_refuses_later_does_not_stop_the_build(tmp_path):
    path = tmp_path / "gone" / "x.prom"
    with MetricsFile(path, "out") as metrics:
        for entry in path.parent.iterdir():
            entry.unlink()
        path.parent.rmdir()
        metrics.show(busy())
    assert not path.exists()


@pytest.mark.parametrize(
    ("out", "name"), [("/data/scenes", "scenes"), ("s3://bucket/a/b/", "b"), ("out", "out"), ("/", "dataset")]
)
def test_the_dataset_is_named_after_its_folder(out, name):
    assert dataset_name(out) == name


EXPOSED = {
    name
    for metric in METRICS
    for name in (
        (f"{metric.name}_bucket", f"{metric.name}_sum", f"{metric.name}_count")
        if metric.kind == "histogram"
        else (metric.name,)
    )
}
LABELS = {"dataset", "le", *(label for metric in METRICS for label in metric.labels)}


def queries() -> dict[str, str]:
    """Every query in deploy/, by where it stands."""
    dashboard = json.loads((ROOT / "deploy" / "grafana" / "tableverse.json").read_text())
    found = {
        f"panel {panel['title']}: {number}": target["expr"]
        for panel in dashboard["panels"]
        for number, target in enumerate(panel.get("targets", ()))
    }
    found |= {f"variable {v['name']}": v["definition"] for v in dashboard["templating"]["list"] if "definition" in v}
    rules = yaml.safe_load((ROOT / "deploy" / "prometheus" / "alerts.yml").read_text())
    return found | {rule["alert"]: rule["expr"] for group in rules["groups"] for rule in group["rules"]}


@pytest.mark.parametrize(("where", "query"), queries().items(), ids=queries())
def test_every_query_asks_for_what_there_is(where, query):
    assert query.count("(") == query.count(")")
    asked = set(re.findall(r"\b(?:ray_)?tableverse_\w+", query))
    assert asked
    assert asked <= EXPOSED
    grouped = {label for group in re.findall(r"\b(?:by|on) \(([^)]*)\)", query) for label in group.split(", ")}
    matched = set(re.findall(r"[{,](\w+)(?:=|!=)", query))
    assert grouped | matched <= LABELS


def test_the_dashboard_shows_every_metric_and_its_panels_do_not_overlap():
    asked = " ".join(queries().values())
    unseen = {metric.name for metric in METRICS if metric.name not in asked}
    assert unseen == set()
    panels = json.loads((ROOT / "deploy" / "grafana" / "tableverse.json").read_text())["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    cells = [
        (x, y)
        for panel in panels
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert max(x for x, _ in cells) < 24


def test_the_scrape_configuration_gives_rays_names_their_own_form():
    config = yaml.safe_load((ROOT / "deploy" / "prometheus" / "prometheus.yml").read_text())
    assert config["rule_files"] == ["alerts.yml"]
    jobs = {job["job_name"]: job["metric_relabel_configs"] for job in config["scrape_configs"]}
    rename = jobs["tableverse-ray"][0]
    for metric in METRICS:
        assert re.fullmatch(rename["regex"], f"ray_{metric.name}").group(1) == metric.name
        assert re.fullmatch(jobs["tableverse-textfile"][0]["regex"], metric.name)


def test_the_page_on_monitoring_lists_the_metrics():
    page = (ROOT / "docs" / "monitoring.md").read_text()
    listed = re.findall(r"^\| `(tableverse_\w+)` \| (\w+) \| ([^|]*) \| ([^|]*) \|$", page, flags=re.MULTILINE)
    assert listed == [
        (metric.name, metric.kind, ", ".join(f"`{label}`" for label in metric.labels), metric.help.rstrip("."))
        for metric in METRICS
    ]
