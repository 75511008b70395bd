"""Overhead of the factory: builds with stages that do nothing, beside the same pipeline on Ray Data.

Builds run in processes of their own (`workers.bench.run_build`, `workers.bench.ray_data_baseline`), which are measured
from outside.
"""

import hashlib
import importlib.util
import math
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench import noop_pipeline
from tableverse_factory.evaluation.bench.process_meter import CommandMeasurement, measure_command
from tableverse_factory.sources.manifest import write_manifest

NOOP, BURNING = f"{noop_pipeline.__name__}:NOOP_PIPELINES", f"{noop_pipeline.__name__}:BURNING_PIPELINES"
_COPIES = 3  # of a payload on the disk: in its scene, in checkpoints, and in the shard while it is assembled
_BATCH, _BATCH_BYTES = 64, 64_000_000  # most scenes and bytes that Ray Data handles at once
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_KINDS = {"workers.sandbox.child": "sandboxes", "ray::": "actors"}


@dataclass(frozen=True, slots=True)
class FactoryRun:
    """Measurement of one build."""

    what: str  # `local`, `ray`, `burning` or `ray data`
    workers: int
    scenes: int
    working_s: float  # from the start of the driver's work to the last commit, start of workers included [s]
    steady_s: float  # from the first finished scenes to the last commit [s]
    steady_scenes: int  # scenes finished in that time
    driver_ms: float  # CPU time of the driver per scene in that time; nan for a build too short to tell, as driver_kb
    driver_kb: float  # bytes that pass through the driver per scene in that time (`workers.bench.traffic`) [kB]
    cpu_ms: Mapping[str, float]  # CPU time per scene by kind of process, imports and the start of Ray included
    peak_mb: float  # peak resident memory of the driver
    growth_mb: float  # growth of the driver's memory per 10,000 scenes over the second half of the build

    @property
    def rate(self) -> float:
        """Scenes per second, start of workers included."""
        return self.scenes / self.working_s

    @property
    def steady_rate(self) -> float:
        """Scenes per second after the first finished ones; nan for a build too short to tell."""
        return self.steady_scenes / self.steady_s if self.steady_s else math.nan

    @property
    def total_cpu_ms(self) -> float:
        """CPU time per scene over all processes [ms]."""
        return sum(self.cpu_ms.values())


@dataclass(frozen=True, slots=True)
class FactoryComparison:
    """Ratios between runs; nan where a run is missing. Marginal cost is that of one more scene."""

    linear: float  # marginal CPU time of the two largest builds over that of the two smallest: 1 for linear cost
    ray_ms: float  # marginal CPU time that Ray with one worker adds to one process [ms]
    speed_up: float  # steady rate with all workers over that with one, for stages that burn CPU
    to_ray_data: float  # marginal rate of the factory over that of Ray Data


def bench_factory(
    sizes: Sequence[int], workers: int, burning: int, payload: int = 0, show: Callable[[str], None] = lambda _: None
) -> Iterator[FactoryRun]:
    """Measure one build after the other.

    Args:
        sizes: Scenes of the builds on Ray and on Ray Data, ascending; the two smallest also run with one worker.
        workers: Ray workers in each pool.
        burning: Scenes of the builds whose stages burn CPU; 0 for none.
        payload: Size of the files of each scene, except where stages burn CPU [bytes].
        show: Called with a description before each build.
    """
    plan = [("ray", workers, n, NOOP) for n in sizes]
    plan += [(what, 1, n, NOOP) for n in sizes[:2] for what in ("local", "ray") if (what, workers) != ("ray", 1)]
    plan += [("burning", w, burning, BURNING) for w in dict.fromkeys((1, workers)) if burning]
    if importlib.util.find_spec("pandas"):  # without it Ray Data cannot be imported
        plan += [("ray data", workers, n, NOOP) for n in sizes]
    with tempfile.TemporaryDirectory(prefix="tableverse-bench-") as folder:
        _check_free_space(Path(folder), payload * max(sizes))
        for what, with_workers, scenes, line in plan:
            show(f"{what}: {scenes} scenes, {with_workers} workers")
            yield _run_once(what, with_workers, scenes, line, Path(folder), payload)


def compare_runs(runs: Sequence[FactoryRun]) -> FactoryComparison:
    """Compute the ratios between runs."""
    many = max(run.workers for run in runs)
    ray, one, local, data = (
        sorted((r for r in runs if r.what == what and r.workers == workers), key=lambda r: r.scenes)
        for what, workers in (("ray", many), ("ray", 1), ("local", 1), ("ray data", many))
    )
    burning = {run.workers: run.steady_rate for run in runs if run.what == "burning"}
    return FactoryComparison(
        linear=_compute_marginal_ms(ray[-2:]) / _compute_marginal_ms(ray[:2]) if len(ray) > 2 else math.nan,
        ray_ms=_compute_marginal_ms(one[:2]) - _compute_marginal_ms(local[:2]),
        speed_up=burning[many] / burning[1] if len(burning) == 2 else math.nan,
        to_ray_data=_compute_marginal_rate(ray[-2:]) / _compute_marginal_rate(data[-2:]),
    )


def _check_free_space(folder: Path, payload: int) -> None:
    """Refuse payloads that do not fit on the disk together with the checkpoints that hold them."""
    free, needed = shutil.disk_usage(folder).free, _COPIES * payload
    if needed > free:
        raise InputError(
            f"{folder.parent} has {free / 1e9:.0f} GB free and the largest build needs {needed / 1e9:.0f}: give fewer "
            "scenes or a smaller payload, or another folder in TMPDIR"
        )


def _run_once(what: str, workers: int, scenes: int, line: str, folder: Path, payload: int) -> FactoryRun:
    manifest, out = folder / f"{scenes}.parquet", folder / "out"
    if not manifest.exists():
        write_manifest(manifest, (_make_row(number, payload) for number in range(scenes)))
    if what == "ray data":
        batch = max(1, min(_BATCH, _BATCH_BYTES // max(1, payload)))
        arguments: tuple[object, ...] = ("workers.bench.ray_data_baseline", manifest, out, workers, line, batch)
    else:
        executor = "local" if what == "local" else "ray"
        arguments = ("workers.bench.run_build", manifest, out, executor, workers, line)
    command = (sys.executable, "-m", *arguments)
    try:
        measured = measure_command([str(part) for part in command], _QUIET, _classify_process)
        return _summarize_run(what, workers, scenes, measured)
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _summarize_run(what: str, workers: int, scenes: int, seen: CommandMeasurement) -> FactoryRun:
    times, counts, *driver = np.array(seen.lines).T  # with its CPU time and traffic, which Ray Data does not tell
    flowing, ended = int(np.argmax(counts > 0)), int(np.argmax(counts == counts[-1]))
    steady = counts[-1] - counts[flowing] or math.nan
    driver_s, driver_bytes = [(its[ended] - its[flowing]) / steady for its in driver] or (math.nan, math.nan)
    at = np.array(seen.memory)
    late = at[at[:, 0] > (times[0] + times[-1]) / 2]
    done = np.interp(late[:, 0], times, counts)
    growth = float(np.polyfit(done, late[:, 1], 1)[0]) * 10_000 if len(late) > 3 and np.ptp(done) > 0 else 0.0
    return FactoryRun(
        what=what,
        workers=workers,
        scenes=scenes,
        working_s=float(times[-1] - times[0]),
        steady_s=float(times[-1] - times[flowing]),
        steady_scenes=int(counts[-1] - counts[flowing]),
        driver_ms=1e3 * float(driver_s),
        driver_kb=float(driver_bytes) / 1e3,
        cpu_ms={kind: 1e3 * seconds / scenes for kind, seconds in seen.cpu_s.items()},
        peak_mb=float(at[:, 1].max()),
        growth_mb=growth,
    )


def _compute_marginal_ms(runs: Sequence[FactoryRun]) -> float:
    """Compute the CPU time of one more scene between the smallest and the largest run [ms]."""
    if len(runs) < 2:
        return math.nan
    small, large = runs[0], runs[-1]
    extra = large.total_cpu_ms * large.scenes - small.total_cpu_ms * small.scenes
    return extra / (large.scenes - small.scenes)


def _compute_marginal_rate(runs: Sequence[FactoryRun]) -> float:
    """Compute scenes per second between the smallest and the largest run, which leaves out fixed costs."""
    if len(runs) < 2:
        return math.nan
    small, large = runs[0], runs[-1]
    return (large.scenes - small.scenes) / (large.working_s - small.working_s)


def _make_row(number: int, payload: int = 0) -> ImageRow:
    digest, kind = hashlib.sha256(str(number).encode()).hexdigest(), SceneKind.CAPTURE
    place = {"uri": f"/noop/{number}", "name": str(payload) if payload else ""}
    return ImageRow(scene_id=f"noop-{digest[:12]}", kind=kind, content_sha256=digest, licence="CC0-1.0", **place)


def _classify_process(command: str) -> str:
    return next((kind for word, kind in _KINDS.items() if word in command), "ray itself")
