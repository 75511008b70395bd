"""Run of a policy on a benchmark: in parallel, resumable, with the same results from any number of processes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.evaluation.benchmark.benchmark import AXES, SPLITS, Axis, Benchmark, Episode, Split
from tableverse_factory.evaluation.benchmark.episode_processes import EpisodeProcesses, PlayPlan, PolicyDescription
from tableverse_factory.evaluation.benchmark.journal import open_journal
from tableverse_factory.evaluation.benchmark.load_policy import PolicyName
from tableverse_factory.evaluation.benchmark.play import check_scene
from tableverse_factory.evaluation.benchmark.results import EpisodeResult, ResultsHeader, encode_line, encode_results

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
        with open_journal(out, header) as (file, known):
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
    digest, weights = policy.identify()
    return ResultsHeader(
        benchmark=benchmark.digest,
        policy=policy.shown,
        policy_digest=digest,
        weights=weights,
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
