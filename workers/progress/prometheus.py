"""The figures of a running build for Prometheus: as a text file for node_exporter's textfile collector.

docs/monitoring.md says how to hook it up. Labels are bounded: one dataset per build, its stages and pools, three
statuses; never a scene.
"""

import itertools
import math
import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal

from tableverse_factory.core.errors import InputError
from workers.progress.eta import ProgressRate
from workers.progress.tally import BOUNDS_S, Durations, Tally

WRITE_EVERY_S = 5.0
BUCKETS = tuple(number for number in range(len(BOUNDS_S)) if number % 10 in (0, 3, 7))
"""Indices of the bounds that are passed on: 1, 2 and 5 of every decade."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric: its name, what it is, and the labels that it has besides `dataset`."""

    name: str
    kind: Literal["gauge", "counter", "histogram"]
    help: str
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class MetricFamily:
    """A value of a metric; `values` are those of its labels."""

    metric: Metric
    values: tuple[str, ...]
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


def figures(
    tally: Tally, left_s: float | None, updated: float, progress: float, running: bool
) -> Iterator[MetricFamily]:
    """All figures of a tally, those of one metric together.

    Args:
        tally: The counts.
        left_s: Estimated time to the end [s]; None where it is unknown.
        updated: Unix time of now.
        progress: Unix time of the last stage that ended.
        running: Whether the build runs.
    """
    yield from (
        MetricFamily(RUNNING, (), float(running)),
        MetricFamily(UPDATED, (), updated),
        MetricFamily(PROGRESS, (), progress),
        MetricFamily(LEFT, (), math.nan if left_s is None else left_s),
        MetricFamily(PLANNED, (), tally.total),
        MetricFamily(ACCOUNTED, (), tally.accounted),
    )
    statuses: tuple[Literal["done", "dropped", "failed"], ...] = ("done", "dropped", "failed")
    for stage, status in itertools.product(tally.stages, statuses):
        yield MetricFamily(ENDED, (stage, status), tally.ended[stage, status])
    stages = tally.stages[1:]  # the manifest is no stage that anything runs
    for metric, counts in ((PASSED, tally.passed), (QUEUED, tally.queued), (CALLS, tally.running)):
        yield from (MetricFamily(metric, (stage,), counts[stage]) for stage in stages)
    yield from (MetricFamily(WALL, (stage,), tally.wall.get(stage) or Durations()) for stage in stages)
    yield from (MetricFamily(CPU, (stage,), (tally.cpu.get(stage) or Durations()).total_s) for stage in stages)
    yield from (MetricFamily(ALIVE, (pool,), actors.alive) for pool, actors in tally.actors.items())
    yield from (MetricFamily(TARGET, (pool,), actors.target) for pool, actors in tally.actors.items())
    yield from (
        MetricFamily(LOST, (), tally.losses),
        MetricFamily(RESTARTED, (), tally.restarts),
        MetricFamily(SHARDS, (), tally.shards),
        MetricFamily(COMMITTED, (), tally.committed),
        MetricFamily(BYTES, (), tally.bytes_committed),
    )


def prometheus_text(dataset: str, found: Iterator[MetricFamily]) -> str:
    """The figures in Prometheus' text format 0.0.4; figures of one metric must follow one another."""
    lines: list[str] = []
    for metric, group in itertools.groupby(found, key=lambda figure: figure.metric):
        lines += (f"# HELP {metric.name} {metric.help}", f"# TYPE {metric.name} {metric.kind}")
        for figure in group:
            labels = {"dataset": dataset, **dict(zip(metric.labels, figure.values, strict=True))}
            if isinstance(figure.value, Durations):
                lines += _histogram(metric.name, labels, figure.value)
            else:
                lines.append(f"{metric.name}{_labels(labels)} {_number(figure.value)}")
    return "\n".join(lines) + "\n"


class MetricsFile:
    """Writes the figures of a build to a file while the block lasts (a `workers.progress.tally.Display`).

    The file is replaced as a whole, at most every five seconds, and at the end.
    """

    def __init__(self, path: Path, dataset: str) -> None:
        self._path, self._dataset = path, dataset
        self._pace = ProgressRate()
        self._tally: Tally | None = None
        self._written = -math.inf

    def __enter__(self) -> "MetricsFile":
        """Tries the folder, so that a wrong one is said before the work begins.

        Raises:
            InputError: if nothing can be written there.
        """
        if re.match(r"[a-z0-9]+:/", str(self._path)):
            raise InputError(f"--metrics {self._path}: give a file on this machine, where node_exporter finds it")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._temporary.touch()
        except OSError as error:
            raise InputError(f"--metrics {self._path} cannot be written: {error.strerror or error}") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._tally is not None:
            self._write(self._tally, running=False)
        with suppress(OSError):
            self._temporary.unlink(missing_ok=True)

    def show(self, tally: Tally) -> None:
        """Writes, if enough time has passed since it last did."""
        now = time.monotonic()
        self._tally = tally
        self._pace.update(now, tally)
        if now - self._written >= WRITE_EVERY_S:
            self._written = now
            self._write(tally, running=True)

    def note(self, line: str) -> None:
        """Notes are for people."""

    def _write(self, tally: Tally, running: bool) -> None:
        """A disk that refuses costs this look, not the build: the file's own time says that it is old."""
        now, unix = time.monotonic(), time.time()
        found = figures(tally, self._pace.estimate_left_s(now, tally), unix, unix - self._pace.idle_s(now), running)
        with suppress(OSError):
            self._temporary.write_text(prometheus_text(self._dataset, found), encoding="utf-8")
            self._temporary.replace(self._path)

    @property
    def _temporary(self) -> Path:
        return self._path.with_name(f".{self._path.name}.{os.getpid()}")


def dataset_name(out: object) -> str:
    """The last part of OUT's path or address, which the label `dataset` says."""
    return str(out).rstrip("/").rpartition("/")[2] or "dataset"


def _histogram(name: str, labels: dict[str, str], durations: Durations) -> list[str]:
    cumulative = tuple(itertools.accumulate(durations.buckets))
    ends = [(f"{BOUNDS_S[number]:g}", cumulative[number]) for number in BUCKETS] + [("+Inf", cumulative[-1])]
    return [
        *(f"{name}_bucket{_labels({**labels, 'le': end})} {count}" for end, count in ends),
        f"{name}_sum{_labels(labels)} {_number(durations.total_s)}",
        f"{name}_count{_labels(labels)} {cumulative[-1]}",
    ]


def _labels(labels: dict[str, str]) -> str:
    escaped = (
        (name, value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")) for name, value in labels.items()
    )
    return "{" + ",".join(f'{name}="{value}"' for name, value in escaped) + "}"


def _number(value: float) -> str:
    return "NaN" if math.isnan(value) else repr(value)
