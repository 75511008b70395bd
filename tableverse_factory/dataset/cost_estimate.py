"""Cost estimate of a larger build from the scenes of a smaller one, with bootstrap intervals.

Every figure is the mean over the measured scenes times the scenes wanted; scenes that were dropped early count with the
little that they took. The interval is that of the mean, by a bootstrap-t over the scenes, which suits the long tails of
durations better than percentiles do (Efron and Tibshirani 1993, section 12.5).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from schemas.pools import Pools, PoolSpec
from tableverse_factory.core.errors import BuildError, ConfigError

MIN_SCENES = 50
LEVEL = 0.95
SEED = 20260
# Prices per hour of a CPU or GPU, GB stored for a month, million tokens read or written
PRICES = ("cpu_hour", "gpu_hour", "gb_month", "input_mtok", "output_mtok")
_MIN_RESAMPLES, _MAX_RESAMPLES = 200, 1000
_MAX_DRAWS = 20_000_000
_DRAWS_AT_ONCE = 1_000_000
_LEAST_DEVIATION = 0.1
_HOUR_S = 3600.0

Values: TypeAlias = Float[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class StageTimes:
    """CPU and wall times of one stage on every measured scene [s]; 0 for scenes that did not reach it."""

    name: str
    pool: str  # of workers that run it
    cpu_s: Values
    wall_s: Values


@dataclass(frozen=True, slots=True, eq=False)
class BuildSample:
    """Measured costs of a build, one entry per scene; storage and tokens may be known of fewer scenes."""

    stages: tuple[StageTimes, ...]  # in the order in which they run
    storage: Mapping[str, Values] = field(default_factory=dict)  # [bytes], by what holds them
    input_tokens: Values = field(default_factory=lambda: np.zeros(0))
    output_tokens: Values = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()  # what could not be measured

    @property
    def scenes(self) -> int:
        """Number of measured scenes."""
        return len(self.stages[0].cpu_s) if self.stages else 0


@dataclass(frozen=True, slots=True)
class ClusterSize:
    """CPUs and GPUs of a cluster."""

    cpus: float
    gpus: float = 0.0


@dataclass(frozen=True, slots=True)
class IntervalEstimate:
    """An estimate with its interval at `LEVEL`."""

    value: float
    low: float
    high: float

    def scale(self, factor: float) -> "IntervalEstimate":
        """Multiply by a factor that is not negative."""
        return IntervalEstimate(self.value * factor, self.low * factor, self.high * factor)

    def add(self, other: "IntervalEstimate") -> "IntervalEstimate":
        """Add another estimate; the interval allows both to be off to the same side."""
        return IntervalEstimate(self.value + other.value, self.low + other.low, self.high + other.high)


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """Cost estimate of a build."""

    scenes: int
    measured: int
    cpu_hours: IntervalEstimate  # CPU time that the stages use
    cpu_hours_held: IntervalEstimate  # CPUs that actors hold, waiting included
    gpu_hours: IntervalEstimate  # GPUs that actors hold
    waiting_share: float  # of the stages' wall time, what is no CPU time
    storage: Mapping[str, IntervalEstimate]  # [bytes], by what holds them
    input_tokens: IntervalEstimate
    output_tokens: IntervalEstimate
    wall_hours: IntervalEstimate | None  # on the stated cluster if no worker is ever idle; None if none was stated
    least_wall_hours: IntervalEstimate | None  # the same without waiting for models or crowded machines
    bottleneck: str  # of the wall time
    costs: Mapping[str, IntervalEstimate]  # by purpose, in the currency of the prices
    stages: Mapping[str, tuple[IntervalEstimate, IntervalEstimate]]  # CPU and wall time per scene that enters [s]
    notes: tuple[str, ...]  # what was left out


def estimate_cost(
    measured: BuildSample, scenes: int, pools: Pools, cluster: ClusterSize | None, prices: Mapping[str, float]
) -> CostEstimate:
    """Estimate the cost of a build of `scenes` scenes like the measured ones; missing `PRICES` are 0."""
    if measured.scenes < MIN_SCENES:
        raise BuildError(
            f"{measured.scenes} scenes with timings are too few to say what {scenes} will take: build at least "
            f"{MIN_SCENES}, better some hundreds, of the same kind first"
        )
    n = measured.scenes
    cpu = _sum_times([stage.cpu_s for stage in measured.stages], n)
    wall = _sum_times([stage.wall_s for stage in measured.stages], n)
    hours = {
        name: bootstrap_total(values, scenes).scale(1.0 / _HOUR_S)
        for name, values in _compute_held_seconds(measured, pools).items()
    }
    cpu_hours = bootstrap_total(cpu, scenes).scale(1.0 / _HOUR_S)
    storage = {name: bootstrap_total(values, scenes) for name, values in measured.storage.items()}
    tokens = bootstrap_total(measured.input_tokens, scenes), bootstrap_total(measured.output_tokens, scenes)
    wall_hours, bottleneck = (
        (None, "") if cluster is None else _find_bottleneck(measured, scenes, pools, cluster, hours, cpu_hours)
    )
    return CostEstimate(
        scenes=scenes,
        measured=n,
        cpu_hours=cpu_hours,
        cpu_hours_held=hours["CPU"],
        gpu_hours=hours["GPU"],
        waiting_share=max(0.0, 1.0 - float(cpu.sum() / wall.sum())) if wall.sum() > 0 else 0.0,
        storage=storage,
        input_tokens=tokens[0],
        output_tokens=tokens[1],
        wall_hours=wall_hours,
        least_wall_hours=None if cluster is None else cpu_hours.scale(1.0 / cluster.cpus),
        bottleneck=bottleneck,
        costs=_compute_costs(prices, hours, wall_hours, cluster, storage, tokens),
        stages={
            stage.name: (bootstrap_total(stage.cpu_s, 1), bootstrap_total(stage.wall_s, 1)) for stage in measured.stages
        },
        notes=measured.notes,
    )


def bootstrap_total(values: Values, scenes: int) -> IntervalEstimate:
    """Scale the mean of values to a number of scenes, with its bootstrap interval; 0 if there are no values.

    Linear in `scenes`. The generator starts from `SEED` every time, so equal values give equal intervals. The sum of
    few new scenes scatters more than the interval, which is that of the mean.
    """
    n = len(values)
    if n == 0:
        return IntervalEstimate(0.0, 0.0, 0.0)
    mean, deviation = float(values.mean()), float(values.std())
    if deviation == 0.0 or n == 1:
        return IntervalEstimate(mean * scenes, mean * scenes, mean * scenes)
    rng = np.random.default_rng(SEED)
    resamples = max(_MIN_RESAMPLES, min(_MAX_RESAMPLES, _MAX_DRAWS // n))
    students = np.empty(resamples)
    at_once = max(1, _DRAWS_AT_ONCE // n)
    for start in range(0, resamples, at_once):
        drawn = values[rng.integers(0, n, (min(at_once, resamples - start), n))]
        # a draw of (nearly) equal values would make the statistic infinite
        spread = np.maximum(drawn.std(axis=1), _LEAST_DEVIATION * deviation)
        students[start : start + at_once] = (drawn.mean(axis=1) - mean) / spread
    low, high = np.quantile(students, [(1.0 + LEVEL) / 2.0, (1.0 - LEVEL) / 2.0])
    least = max(0.0, mean - float(low) * deviation)
    most = max(mean, mean - float(high) * deviation)
    return IntervalEstimate(mean * scenes, min(mean, least) * scenes, most * scenes)


def parse_amounts(text: Sequence[str], allowed: Sequence[str], option: str) -> dict[str, float]:
    """Parse `name=number` entries."""
    found: dict[str, float] = {}
    for entry in text:
        name, separator, value = entry.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not separator or name not in allowed or not (0.0 <= number < math.inf):
            raise ConfigError(f"{option} {entry[:80]}: give NAME=NUMBER with one of {', '.join(allowed)}")
        found[name] = number
    return found


def _sum_times(parts: Sequence[Values], n: int) -> Values:
    return np.sum(parts, axis=0) if parts else np.zeros(n)


def _get_spec(pools: Pools, pool: str) -> PoolSpec:
    return getattr(pools, pool)


def _compute_held_seconds(measured: BuildSample, pools: Pools) -> dict[str, Values]:
    """Compute the CPU and GPU seconds that actors hold per scene: wall times times the resources of an actor."""
    held = [(stage, _get_spec(pools, stage.pool)) for stage in measured.stages]
    return {
        "CPU": _sum_times([stage.wall_s * spec.cpus for stage, spec in held], measured.scenes),
        "GPU": _sum_times([stage.wall_s * spec.gpus for stage, spec in held], measured.scenes),
    }


def _find_bottleneck(
    measured: BuildSample,
    scenes: int,
    pools: Pools,
    cluster: ClusterSize,
    hours: Mapping[str, IntervalEstimate],
    cpu_hours: IntervalEstimate,
) -> tuple[IntervalEstimate, str]:
    """Find the longest of: CPUs held, CPU time used, GPUs held, and the pools of bounded size."""
    if hours["GPU"].value > 0 and cluster.gpus == 0:
        raise BuildError("the pools hold GPUs and the stated cluster has none: give gpus=NUMBER too")
    bounds = [
        (hours["CPU"].scale(1.0 / cluster.cpus), "the CPUs that actors hold"),
        (cpu_hours.scale(1.0 / cluster.cpus), "CPU time"),
    ]
    if cluster.gpus:
        bounds.append((hours["GPU"].scale(1.0 / cluster.gpus), "the GPUs that actors hold"))
    for pool in dict.fromkeys(stage.pool for stage in measured.stages):
        if (most := _get_spec(pools, pool).max) is not None:
            values = _sum_times([stage.wall_s for stage in measured.stages if stage.pool == pool], measured.scenes)
            bounds.append(
                (bootstrap_total(values, scenes).scale(1.0 / _HOUR_S / most), f"pool {pool} with at most {most} actors")
            )
    longest, why = max(bounds, key=lambda bound: bound[0].value)
    ranges = [bound for bound, _ in bounds]
    return IntervalEstimate(longest.value, max(r.low for r in ranges), max(r.high for r in ranges)), why


def _compute_costs(
    prices: Mapping[str, float],
    hours: Mapping[str, IntervalEstimate],
    wall_hours: IntervalEstimate | None,
    cluster: ClusterSize | None,
    storage: Mapping[str, IntervalEstimate],
    tokens: tuple[IntervalEstimate, IntervalEstimate],
) -> dict[str, IntervalEstimate]:
    """Compute costs; machines are paid for the whole cluster's time if one is stated, else for what is held."""
    cpu_hour, gpu_hour = prices.get("cpu_hour", 0.0), prices.get("gpu_hour", 0.0)
    costs: dict[str, IntervalEstimate] = {}
    if cpu_hour or gpu_hour:
        if wall_hours is not None and cluster is not None:
            costs["machines"] = wall_hours.scale(cluster.cpus * cpu_hour + cluster.gpus * gpu_hour)
        else:
            costs["machines"] = hours["CPU"].scale(cpu_hour).add(hours["GPU"].scale(gpu_hour))
    if "input_mtok" in prices or "output_mtok" in prices:
        read, written = (prices.get(name, 0.0) / 1e6 for name in ("input_mtok", "output_mtok"))
        costs["models"] = tokens[0].scale(read).add(tokens[1].scale(written))
    if "gb_month" in prices:
        kept = IntervalEstimate(0.0, 0.0, 0.0)
        for size in storage.values():
            kept = kept.add(size)
        costs["storage per month"] = kept.scale(prices["gb_month"] / 1e9)
    return costs
