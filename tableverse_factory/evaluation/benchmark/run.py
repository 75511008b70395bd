"""Run of a policy on a benchmark: in parallel, resumable, with the same results from any number of processes."""

import fcntl
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.evaluation.benchmark.benchmark import AXES, SPLITS, Axis, Benchmark, Episode, Split
from tableverse_factory.evaluation.benchmark.episode_processes import EpisodeProcesses, PlayPlan, PolicyDescription
from tableverse_factory.evaluation.benchmark.load_policy import PolicyName
from tableverse_factory.evaluation.benchmark.play import check_scene
from tableverse_factory.evaluation.benchmark.results import (
    EpisodeResult,
    ResultsHeader,
    decode_results,
    encode_line,
    encode_results,
    read_results,
)

EPISODE_S = 300.0


@dataclass(frozen=True, slots=True)
class RunSettings:
    """Which episodes are played, on how many processes, and the wall time of each [s]."""

    splits: Sequence[Split] = SPLITS
    axes: Sequence[Axis] = AXES
    jobs: int = 1
    episode_s: float = EPISODE_S


def run_benchmark(
    benchmark: Benchmark,
    dataset: Dataset,
    policy: PolicyName,
    out: Path,
    settings: RunSettings,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> tuple[ResultsHeader, tuple[EpisodeResult, ...]]:
    """Play the episodes that `out` lacks, and write it; return what it then holds, in the order of the benchmark.

    Rows are first appended to `out` + `.journal`, so that a run which was killed goes on with the same command. The
    outcome of an episode depends on nothing else, but for `policy_timeout`, which depends on the machine.

    Raises:
        InputError: `other_scenes` if the dataset is not the benchmark's, `other_results` if `out` is of another
            benchmark or policy, `bad_policy` if the policy does not load.
    """
    chosen = [e for e in benchmark.episodes if e.split in settings.splits and e.perturbation.axis in settings.axes]
    if not chosen:
        raise InputError("the benchmark has no episodes of these splits and axes: give others", "no_episodes")
    check_scenes(benchmark, dataset, chosen)
    plan = PlayPlan(benchmark, dataset.path, policy)
    with EpisodeProcesses(plan, settings.episode_s) as processes:
        header = _make_header(benchmark, policy, processes.describe_policy())
        with _open_journal(out, header) as (file, known):
            left = [episode for episode in chosen if episode.episode_id not in known]
            total = len(known) + len(left)
            progress(len(known), total)
            for result in processes.play(left, settings.jobs):
                file.write(encode_line(result))
                file.flush()
                known[result.episode_id] = result
                progress(len(known), total)
            rows = tuple(known[e.episode_id] for e in benchmark.episodes if e.episode_id in known)
            write_atomic(out, encode_results(header, rows))
            Path(file.name).unlink()
    return header, rows


def _make_header(benchmark: Benchmark, policy: PolicyName, seen: PolicyDescription) -> ResultsHeader:
    return ResultsHeader(
        benchmark=benchmark.digest,
        policy=policy.shown,
        policy_digest=policy.digest,
        privileged=seen.privileged,
        pictures=seen.pictures,
        picture_size=seen.picture_size,
    )


def check_scenes(benchmark: Benchmark, dataset: Dataset, episodes: Sequence[Episode]) -> None:
    """Check that the dataset's scenes are those of the benchmark; InputError `other_scenes` if not."""
    known = set(dataset.scenes.to_table(columns=["scene_id"])["scene_id"].to_pylist())
    needed = sorted({scene for episode in episodes for scene in episode.scenes})
    if missing := [scene for scene in needed if scene not in known]:
        raise InputError(
            f"{dataset.path} lacks {len(missing)} of {len(needed)} scenes of the benchmark, e.g. {missing[0]}: "
            "give the dataset that it was made of, or build that again from its seed with the same version",
            "other_scenes",
        )
    for scene in needed:
        check_scene(benchmark, dataset.scene(scene))


@contextmanager
def _open_journal(out: Path, header: ResultsHeader) -> Iterator[tuple[BinaryIO, dict[str, EpisodeResult]]]:
    """Open the file that rows are appended to, locked, with the rows that it and `out` hold."""
    path = out.with_name(f"{out.name}.journal")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise BuildError(
                f"{out}: another process writes these results; wait for it, or give another --out"
            ) from None
        known = dict(read_results(out)[1]) if _is_of_run(out, header) else {}
        file.seek(0)
        data = file.read()
        whole = data[: data.rfind(b"\n") + 1]  # a killed process may have torn its last line
        file.truncate(len(whole))
        if whole:
            found, rows = decode_results(whole, str(path))
            _check_header(path, found, header)
            known |= rows
        else:
            file.write(encode_line(header))
            file.flush()
        yield file, known


def _is_of_run(out: Path, header: ResultsHeader) -> bool:
    if not out.exists():
        return False
    _check_header(out, read_results(out)[0], header)
    return True


def _check_header(path: Path, found: ResultsHeader, header: ResultsHeader) -> None:
    if found == header:
        return
    names = [name for name in ResultsHeader.model_fields if getattr(found, name) != getattr(header, name)]
    raise InputError(
        f"{path} holds results of another run ({', '.join(names)} differ): give another --out, or remove it",
        "other_results",
    )
