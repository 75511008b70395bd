"""Metrics of a running build in Ray's own metrics, where a cluster's Prometheus finds them."""

import math
import time
from typing import Any

from ray.util.metrics import Counter, Gauge, Histogram

from workers.progress.eta import ProgressRate
from workers.progress.prometheus import BUCKETS, METRICS, Metric, Sample, collect_samples
from workers.progress.tally import BOUNDS_S, Durations, Tally

UPDATE_EVERY_S = 2.0


class RayMetrics:
    """Ray's instruments, updated with the changes of a tally; Ray puts `ray_` before their names.

    A duration is passed on as the middle of its bucket, which is at most 28 % wide: Ray's sums are made of middles
    anyway.
    """

    def __init__(self, dataset: str) -> None:
        self._dataset = dataset
        self._rate = ProgressRate()
        self._instruments: dict[str, Any] = {metric.name: _make_instrument(metric) for metric in METRICS}
        self._reported: dict[tuple[str, tuple[str, ...]], Any] = {}
        self._updated = 0.0

    def show(self, tally: Tally) -> None:
        """Update Ray's metrics, if enough time has passed since the last time."""
        now = time.monotonic()
        self._rate.update(now, tally)
        if now - self._updated < UPDATE_EVERY_S:
            return
        self._updated, unix = now, time.time()
        left_s = self._rate.estimate_left_s(now, tally)
        for sample in collect_samples(tally, left_s, unix, unix - self._rate.idle_s(now), running=True):
            self._report(sample)

    def note(self, line: str) -> None:
        """Ignore notes, which are for people."""

    def _report(self, sample: Sample) -> None:
        metric, key = sample.metric, (sample.metric.name, sample.labels)
        tags = {"dataset": self._dataset, **dict(zip(metric.labels, sample.labels, strict=True))}
        instrument = self._instruments[metric.name]
        if isinstance(sample.value, Durations):
            before = self._reported.get(key, [0] * len(sample.value.buckets))
            self._reported[key] = list(sample.value.buckets)
            for number, (now, then) in enumerate(zip(sample.value.buckets, before, strict=True)):
                for _ in range(now - then):
                    instrument.observe(_find_middle_s(number), tags)
        elif metric.kind == "gauge":
            if math.isnan(sample.value):
                return  # Ray would drop it: the last known value stays
            instrument.set(float(sample.value), tags)
        elif (increase := sample.value - self._reported.get(key, 0)) > 0:
            self._reported[key] = sample.value
            instrument.inc(float(increase), tags)


def _make_instrument(metric: Metric) -> Any:
    labels = ("dataset", *metric.labels)
    if metric.kind == "histogram":
        return Histogram(metric.name, metric.help, [BOUNDS_S[number] for number in BUCKETS], labels)
    return (Gauge if metric.kind == "gauge" else Counter)(metric.name, metric.help, labels)


def _find_middle_s(number: int) -> float:
    """Find the middle of a bucket [s]."""
    low = BOUNDS_S[number - 1] if number else 0.0
    return (low + BOUNDS_S[min(number, len(BOUNDS_S) - 1)]) / 2.0 if number < len(BOUNDS_S) else 2.0 * low
