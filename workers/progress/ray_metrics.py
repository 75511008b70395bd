"""The figures of a running build in Ray's own metrics, where a cluster's Prometheus finds them."""

import math
import time
from typing import Any

from ray.util.metrics import Counter, Gauge, Histogram

from workers.progress.eta import ProgressRate
from workers.progress.prometheus import BUCKETS, METRICS, Metric, MetricFamily, figures
from workers.progress.tally import BOUNDS_S, Durations, Tally

UPDATE_EVERY_S = 2.0


class RayMetrics:
    """Tells Ray what has changed since it was last told (a `workers.progress.tally.Display`).

    Ray puts `ray_` before the names. A duration is passed on as the middle of its bucket, which is at most 28 %
    wide; Ray's sums are made of the middles of its own buckets in any case.
    """

    def __init__(self, dataset: str) -> None:
        self._dataset = dataset
        self._pace = ProgressRate()
        self._metrics: dict[str, Any] = {metric.name: _instrument(metric) for metric in METRICS}
        self._told: dict[tuple[str, tuple[str, ...]], Any] = {}
        self._updated = 0.0

    def show(self, tally: Tally) -> None:
        """Tells Ray, if enough time has passed since it last did."""
        now = time.monotonic()
        self._pace.update(now, tally)
        if now - self._updated < UPDATE_EVERY_S:
            return
        self._updated, unix = now, time.time()
        for figure in figures(tally, self._pace.estimate_left_s(now, tally), unix, unix - self._pace.idle_s(now), True):
            self._tell(figure)

    def note(self, line: str) -> None:
        """Notes are for people."""

    def _tell(self, figure: MetricFamily) -> None:
        metric, key = figure.metric, (figure.metric.name, figure.values)
        tags = {"dataset": self._dataset, **dict(zip(metric.labels, figure.values, strict=True))}
        instrument = self._metrics[metric.name]
        if isinstance(figure.value, Durations):
            before = self._told.get(key, [0] * len(figure.value.buckets))
            self._told[key] = list(figure.value.buckets)
            for number, (now, then) in enumerate(zip(figure.value.buckets, before, strict=True)):
                for _ in range(now - then):
                    instrument.observe(_middle(number), tags)
        elif metric.kind == "gauge":
            if math.isnan(figure.value):
                return  # Ray would drop it: the last value that was known stays
            instrument.set(float(figure.value), tags)
        elif (more := figure.value - self._told.get(key, 0)) > 0:
            self._told[key] = figure.value
            instrument.inc(float(more), tags)


def _instrument(metric: Metric) -> Any:
    labels = ("dataset", *metric.labels)
    if metric.kind == "histogram":
        return Histogram(metric.name, metric.help, [BOUNDS_S[number] for number in BUCKETS], labels)
    return (Gauge if metric.kind == "gauge" else Counter)(metric.name, metric.help, labels)


def _middle(number: int) -> float:
    """A duration within a bucket [s]."""
    low = BOUNDS_S[number - 1] if number else 0.0
    return (low + BOUNDS_S[min(number, len(BOUNDS_S) - 1)]) / 2.0 if number < len(BOUNDS_S) else 2.0 * low
