"""What the factory itself costs: scenes through stages that do nothing, with commits to disk; Ray Data beside it.

Builds run in processes of their own (`workers.bench.run_build`, `workers.bench.ray_data_baseline`) and are watched from outside.
"""

import hashlib
import importlib.util
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.evaluation.bench import noop_pipeline
from tableverse_factory.evaluation.bench.process_meter import Watched, python, watch
from tableverse_factory.sources.manifest import write_manifest

LINES, BURNING = f"{noop_pipeline.__name__}:LINES", f"{noop_pipeline.__name__}:BURNING"
_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
_KINDS = {"workers.sandbox.child": "sandboxes", "ray::": "actors"}


@dataclass(frozen=True, slots=True)
class FactoryRun:
    """One build, measured.

    Attributes:
        what: `local`, `ray`, `burning` or `ray data`.
        working_s: From the moment the driver begins to work until everything is committed, workers' start included [s].
        steady_s: The same from the first second in which scenes were finished [s].
        steady_scenes: Scenes that were finished in that time.
        cpu_ms: CPU time per scene by kind of process, imports and the start of Ray included [ms].
        peak_mb: Most resident memory of the driver [MB].
        growth_mb: What the driver's memory grows per 10,000 scenes over the second half of the build [MB].
    """

    what: str
    workers: int
    scenes: int
    working_s: float
    steady_s: float
    steady_scenes: int
    cpu_ms: Mapping[str, float]
    peak_mb: float
    growth_mb: float

    @property
    def rate(self) -> float:
        """Scenes per second, workers' start included."""
        return self.scenes / self.working_s

    @property
    def steady_rate(self) -> float:
        """Scenes per second once they flow; nan where the build was over before that could be seen."""
        return self.steady_scenes / self.steady_s if self.steady_s else float("nan")

    @property
    def total_cpu_ms(self) -> float:
        """CPU time per scene over all processes [ms]."""
        return sum(self.cpu_ms.values())


@dataclass(frozen=True, slots=True)
class FactoryComparison:
    """Ratios of runs of one session; nan where a run that they need was not asked for.

    Attributes:
        linear: Marginal CPU time per scene from the second largest to the largest build, over that from the smallest to
            the second largest: 1 where cost is linear.
        ray_ms: CPU time that a scene costs more on Ray with one worker than in one process, marginal [ms].
        speed_up: Steady rate with all workers over that with one, on stages that burn CPU.
        to_ray_data: Marginal rate of the factory over that of Ray Data.
    """

    linear: float
    ray_ms: float
    speed_up: float
    to_ray_data: float


def bench_factory(
    sizes: Sequence[int], workers: int, burning: int, show: Callable[[str], None] = lambda _: None
) -> Iterator[FactoryRun]:
    """Measures, one build after the other.

    Args:
        sizes: Scenes of the builds on Ray and on Ray Data, ascending; the two smallest are built with one worker, too.
        workers: Of Ray, in each pool.
        burning: Scenes of the builds whose stages burn CPU; 0 for none.
        show: Is told what runs next.
    """
    plan = [("ray", workers, n, LINES) for n in sizes]
    plan += [(what, 1, n, LINES) for n in sizes[:2] for what in ("local", "ray") if (what, workers) != ("ray", 1)]
    plan += [("burning", w, burning, BURNING) for w in dict.fromkeys((1, workers)) if burning]
    if importlib.util.find_spec("pandas"):  # without it Ray Data cannot be imported
        plan += [("ray data", workers, n, LINES) for n in sizes]
    with tempfile.TemporaryDirectory(prefix="tableverse-bench-") as folder:
        for what, with_workers, scenes, line in plan:
            show(f"{what}: {scenes} scenes, {with_workers} workers")
            yield _run(what, with_workers, scenes, line, Path(folder))


def compare(runs: Sequence[FactoryRun]) -> FactoryComparison:
    """The ratios of the runs of one session."""
    many = max(run.workers for run in runs)
    ray, one, local, data = (
        sorted((r for r in runs if r.what == what and r.workers == workers), key=lambda r: r.scenes)
        for what, workers in (("ray", many), ("ray", 1), ("local", 1), ("ray data", many))
    )
    burning = {run.workers: run.steady_rate for run in runs if run.what == "burning"}
    return FactoryComparison(
        linear=_marginal_ms(ray[-2:]) / _marginal_ms(ray[:2]) if len(ray) > 2 else float("nan"),
        ray_ms=_marginal_ms(one[:2]) - _marginal_ms(local[:2]),
        speed_up=burning[many] / burning[1] if len(burning) == 2 else float("nan"),
        to_ray_data=_marginal_rate(ray[-2:]) / _marginal_rate(data[-2:]),
    )


def _run(what: str, workers: int, scenes: int, line: str, folder: Path) -> FactoryRun:
    manifest, out = folder / f"{scenes}.parquet", folder / "out"
    if not manifest.exists():
        write_manifest(manifest, (_row(number) for number in range(scenes)))
    if what == "ray data":
        command = python("workers.bench.ray_data_baseline", manifest, out, workers, line)
    else:
        command = python("workers.bench.run_build", manifest, out, "local" if what == "local" else "ray", workers, line)
    try:
        return _measured(what, workers, scenes, watch(command, _QUIET, _kind))
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _measured(what: str, workers: int, scenes: int, seen: Watched) -> FactoryRun:
    times, counts = np.array(seen.lines).T
    flowing = int(np.argmax(counts > 0))
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
        cpu_ms={kind: 1e3 * seconds / scenes for kind, seconds in seen.cpu_s.items()},
        peak_mb=float(at[:, 1].max()),
        growth_mb=growth,
    )


def _marginal_ms(runs: Sequence[FactoryRun]) -> float:
    """CPU time of one scene more [ms], between the smallest and the largest of the runs."""
    if len(runs) < 2:
        return float("nan")
    small, large = runs[0], runs[-1]
    extra = large.total_cpu_ms * large.scenes - small.total_cpu_ms * small.scenes
    return extra / (large.scenes - small.scenes)


def _marginal_rate(runs: Sequence[FactoryRun]) -> float:
    """Scenes per second between the smallest and the largest of the runs: what takes its time once is left out."""
    if len(runs) < 2:
        return float("nan")
    small, large = runs[0], runs[-1]
    return (large.scenes - small.scenes) / (large.working_s - small.working_s)


def _row(number: int) -> ImageRow:
    digest = hashlib.sha256(str(number).encode()).hexdigest()
    uri = f"/noop/{number}"
    return ImageRow(
        scene_id=f"noop-{digest[:12]}", kind=SceneKind.CAPTURE, uri=uri, content_sha256=digest, licence="CC0-1.0"
    )


def _kind(command: str) -> str:
    return next((kind for word, kind in _KINDS.items() if word in command), "ray itself")
