"""Metrics of a running build for Prometheus, as a text file for node_exporter's textfile collector.

docs/monitoring.md describes the setup. Labels are bounded: one dataset per build, its stages and pools, three
statuses; never a scene.
"""

import itertools
import math
import os
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Literal

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric as Family

from tableverse_factory.core.errors import InputError
from workers.progress.eta import ProgressRate
from workers.progress.tally import BOUNDS_S, Durations, Tally

WRITE_EVERY_S = 5.0
BUCKETS = tuple(n for n in range(len(BOUNDS_S)) if n % 10 in (0, 3, 7))  # of exported bounds: 1, 2, 5 per decade


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric; `labels` are those besides `dataset`."""

    name: str
    kind: Literal["gauge", "counter", "histogram"]
    help: str
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Sample:
    """A value of a metric for the values of its labels."""

    metric: Metric
    labels: tuple[str, ...]
    value: float | Durations


RUNNING = Metric("tableverse_build_running", "gauge", "1 while the build runs, 0 when it has ended by itself.")
UPDATED = Metric("tableverse_build_updated_timestamp_seconds", "gauge", "When these figures were taken.")
PROGRESS = Metric("tableverse_build_last_progress_timestamp_seconds", "gauge", "When a stage last ended on a scene.")
LEFT = Metric("tableverse_build_left_seconds", "gauge", "Estimated time until the build is complete; NaN: unknown.")
PLANNED = Metric("tableverse_scenes_planned", "gauge", "Scenes of the plan.")
ACCOUNTED = Metric("tableverse_scenes_accounted", "gauge", "Scenes accounted for, of this run and those before.")
ENDED = Metric(
    "tableverse_scenes_ended_total", "counter", "Scenes that ended in this run, where and how.", ("stage", "status")
)
PASSED = Metric("tableverse_stage_passed_total", "counter", "Scenes that went on to the next stage.", ("stage",))
QUEUED = Metric("tableverse_stage_queued", "gauge", "Scenes in the line that wait for the stage.", ("stage",))
CALLS = Metric("tableverse_stage_running", "gauge", "Scenes on which the stage works.", ("stage",))
WALL = Metric("tableverse_stage_wall_seconds", "histogram", "Wall time of a stage on a scene.", ("stage",))
CPU = Metric("tableverse_stage_cpu_seconds_total", "counter", "CPU time that a stage took.", ("stage",))
ALIVE = Metric("tableverse_workers_alive", "gauge", "Workers that live.", ("pool",))
TARGET = Metric("tableverse_workers_target", "gauge", "Workers that the schedule wants.", ("pool",))
LOST = Metric("tableverse_workers_lost_total", "counter", "Workers and records that were lost.")
RESTARTED = Metric("tableverse_workers_restarted_total", "counter", "Workers started in the place of another one.")
SHARDS = Metric("tableverse_shards_planned", "gauge", "Shards of the plan.")
COMMITTED = Metric("tableverse_shards_committed", "gauge", "Shards that are whole.")
BYTES = Metric("tableverse_committed_bytes_total", "counter", "Bytes of the shards that this run committed.")

METRICS = (
    *(RUNNING, UPDATED, PROGRESS, LEFT, PLANNED, ACCOUNTED, ENDED, PASSED, QUEUED, CALLS, WALL, CPU),
    *(ALIVE, TARGET, LOST, RESTARTED, SHARDS, COMMITTED, BYTES),
)


def collect_samples(
    tally: Tally, left_s: float | None, updated: float, progress: float, running: bool
) -> Iterator[Sample]:
    """Collect the samples of all metrics, those of one metric together.

    `left_s` is the estimated time to the end [s], None if unknown; `updated` and `progress` are the Unix times of now
    and of the end of the last stage.
    """
    yield from (
        Sample(RUNNING, (), float(running)),
        Sample(UPDATED, (), updated),
        Sample(PROGRESS, (), progress),
        Sample(LEFT, (), math.nan if left_s is None else left_s),
        Sample(PLANNED, (), tally.total),
        Sample(ACCOUNTED, (), tally.accounted),
    )
    statuses: tuple[Literal["done", "dropped", "failed"], ...] = ("done", "dropped", "failed")
    for stage, status in itertools.product(tally.stages, statuses):
        yield Sample(ENDED, (stage, status), tally.ended[stage, status])
    stages = tally.stages[1:]  # the manifest is no stage that runs
    for metric, counts in ((PASSED, tally.passed), (QUEUED, tally.queued), (CALLS, tally.running)):
        yield from (Sample(metric, (stage,), counts[stage]) for stage in stages)
    yield from (Sample(WALL, (stage,), tally.wall.get(stage) or Durations()) for stage in stages)
    yield from (Sample(CPU, (stage,), (tally.cpu.get(stage) or Durations()).total_s) for stage in stages)
    yield from (Sample(ALIVE, (pool,), actors.alive) for pool, actors in tally.actors.items())
    yield from (Sample(TARGET, (pool,), actors.target) for pool, actors in tally.actors.items())
    yield from (
        Sample(LOST, (), tally.losses),
        Sample(RESTARTED, (), tally.restarts),
        Sample(SHARDS, (), tally.shards),
        Sample(COMMITTED, (), tally.committed),
        Sample(BYTES, (), tally.bytes_committed),
    )


def prometheus_text(dataset: str, samples: Iterable[Sample]) -> str:
    """Format samples in Prometheus' text format 0.0.4; those of one metric must be adjacent."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(
        _Collector([_make_family(dataset, *group) for group in itertools.groupby(samples, attrgetter("metric"))])
    )
    return generate_latest(registry).decode()


class MetricsFile:
    """File of the metrics of a build while the block lasts, replaced every five seconds and at the end."""

    def __init__(self, path: Path, dataset: str) -> None:
        self._path, self._dataset = path, dataset
        self._rate = ProgressRate()
        self._tally: Tally | None = None
        self._written = -math.inf

    def __enter__(self) -> "MetricsFile":
        """Test the folder, so that a wrong one is reported before the build starts."""
        if re.match(r"[a-z0-9]+:/", str(self._path)):
            raise InputError(f"--metrics {self._path}: give a file on this machine, where node_exporter finds it")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._temporary.touch()
        except OSError as error:
            raise InputError(f"--metrics {self._path} cannot be written: {error.strerror or error}") from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._tally is not None:
            self._write(self._tally, running=False)
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def show(self, tally: Tally) -> None:
        """Write the file, if enough time has passed since the last time."""
        now = time.monotonic()
        self._tally = tally
        self._rate.update(now, tally)
        if now - self._written >= WRITE_EVERY_S:
            self._written = now
            self._write(tally, running=True)

    def note(self, line: str) -> None:
        """Ignore notes, which are for people."""

    def _write(self, tally: Tally, running: bool) -> None:
        """Write the file; a full disk costs this update and not the build, and the file's own time shows its age."""
        now, unix = time.monotonic(), time.time()
        left_s = self._rate.estimate_left_s(now, tally)
        samples = collect_samples(tally, left_s, unix, unix - self._rate.idle_s(now), running)
        with suppress(OSError):
            self._temporary.write_text(prometheus_text(self._dataset, samples), encoding="utf-8")
            self._temporary.replace(self._path)

    @property
    def _temporary(self) -> Path:
        return self._path.with_name(f".{self._path.name}.{os.getpid()}")


def dataset_name(out: object) -> str:
    """Name the dataset by the last part of OUT's path or URI, for the label `dataset`."""
    return str(out).rstrip("/").rpartition("/")[2] or "dataset"


class _Collector:
    def __init__(self, families: list[Family]) -> None:
        self._families = families

    def collect(self) -> list[Family]:
        return self._families


def _make_family(dataset: str, metric: Metric, samples: Iterable[Sample]) -> Family:
    labels = ("dataset", *metric.labels)
    if metric.kind == "histogram":
        histogram = HistogramMetricFamily(metric.name, metric.help, labels=labels)
        for sample in samples:
            if isinstance(sample.value, Durations):
                histogram.add_metric((dataset, *sample.labels), _list_buckets(sample.value), sample.value.total_s)
        return histogram
    make = GaugeMetricFamily if metric.kind == "gauge" else CounterMetricFamily
    family = make(metric.name, metric.help, labels=labels)
    for sample in samples:
        if not isinstance(sample.value, Durations):
            family.add_metric((dataset, *sample.labels), sample.value)
    return family


def _list_buckets(durations: Durations) -> list[tuple[str, float]]:
    """List the upper bound of each exported bucket with the number of durations up to it."""
    cumulative = tuple(itertools.accumulate(durations.buckets))
    return [*((f"{BOUNDS_S[number]:g}", cumulative[number]) for number in BUCKETS), ("+Inf", cumulative[-1])]
