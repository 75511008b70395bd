"""`tableverse benchmark`: frozen episodes for policies, runs of policies on them, and their scores."""

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from tableverse_factory.cli.options import AsJson, FinishedOut, Jobs, require_local_path
from tableverse_factory.cli.tables import make_table, print_figures, print_json
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.core.text import pluralize, sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.evaluation.benchmark.results import EpisodeResult
    from tableverse_factory.evaluation.benchmark.score import Rate, Score

Name = TypeVar("Name", bound=str)
MAX_REASONS = 10  # that a run prints

benchmark = typer.Typer(name="benchmark", help="Test policies on frozen episodes of a dataset.", no_args_is_help=True)

BenchmarkFile = Annotated[Path, typer.Argument(metavar="BENCHMARK", help="The file of `benchmark make`.")]


@benchmark.command("make")
def make(
    dataset: FinishedOut,
    dest: Annotated[
        Path, typer.Option("--dest", metavar="FILE", callback=require_local_path, help="The benchmark, JSON.")
    ] = Path("benchmark.json"),
    episodes: Annotated[int, typer.Option(min=1, max=2000, help="Unperturbed episodes of each split, at most.")] = 150,
    perturbed: Annotated[
        int, typer.Option(min=0, max=1000, help="Episodes of unseen pictures that are repeated along each axis.")
    ] = 60,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the choice, and of all that is drawn.")] = 0,
    robot: Annotated[str, typer.Option(metavar="ARM", help="The arm whose motions solve the tasks.")] = "panda",
    jobs: Jobs = None,
) -> None:
    """Freeze episodes of a dataset with trajectories: the same dataset and seed give the same bytes.

    Example: `tableverse benchmark make out --dest benchmark.json`
    """
    from tableverse_factory.core.optional_imports import import_extra
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.core.storage.files import write_atomic
    from tableverse_factory.dataset.dataset import open_dataset

    import_extra("gymnasium", "the benchmark", "gym")
    from tableverse_factory.evaluation.benchmark.make import BenchmarkSettings, make_benchmark

    settings = BenchmarkSettings(episodes, perturbed, seed, robot)
    made = make_benchmark(open_dataset(dataset), settings, jobs or count_available_cpus())
    write_atomic(dest, made.encode())
    counts = dict[tuple[str, str], int]()
    for episode in made.episodes:
        key = (episode.split, episode.perturbation.axis)
        counts[key] = counts.get(key, 0) + 1
    print_figures(("split", "axis", "episodes"), [(*key, count) for key, count in counts.items()])
    print(f"{dest}: {pluralize(len(made.episodes), 'episode')} of {pluralize(len(made.scenes), 'scene')}")
    print(f"sha256 {made.digest}; held out: {', '.join(made.held_out_nouns) or 'no noun'}")


@benchmark.command("run")
def run(
    path: BenchmarkFile,
    dataset: Annotated[str, typer.Option("--dataset", metavar="OUT", help="The dataset that it was made of.")],
    policy: Annotated[
        str,
        typer.Option(
            metavar="POLICY",
            help="planner, replay, random, state, picture, module:Class, file.py:Class, or an address.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", callback=require_local_path, help="The results, lines of JSON.")
    ],
    weights: Annotated[
        str | None, typer.Option(metavar="PATH", help="Given to the policy's class; of replay: the OUT to replay.")
    ] = None,
    title: Annotated[
        str | None, typer.Option("--name", metavar="NAME", help="The policy's name in tables; by default as given.")
    ] = None,
    split: Annotated[list[str] | None, typer.Option(help="Only episodes of this split; may repeat.")] = None,
    axis: Annotated[list[str] | None, typer.Option(help="Only episodes of this axis; may repeat.")] = None,
    episode_s: Annotated[
        float, typer.Option("--episode-timeout", min=1.0, metavar="S", help="Wall time of an episode [s].")
    ] = 300.0,
    jobs: Jobs = None,
) -> None:
    """Let a policy play the episodes of a benchmark; the same command again resumes.

    Exit code 0 however many episodes succeed.

    Example: `tableverse benchmark run benchmark.json --dataset out --policy planner --out planner.jsonl`
    """
    from tableverse_factory.cli.progress_bar import count_progress
    from tableverse_factory.core.optional_imports import import_extra
    from tableverse_factory.core.process_pool import count_available_cpus
    from tableverse_factory.dataset.dataset import open_dataset

    import_extra("gymnasium", "the benchmark", "gym")
    from tableverse_factory.evaluation.benchmark.benchmark import AXES, SPLITS, read_benchmark
    from tableverse_factory.evaluation.benchmark.load_policy import PolicyName
    from tableverse_factory.evaluation.benchmark.run import RunSettings, run_benchmark

    settings = RunSettings(
        _choose("--split", split, SPLITS), _choose("--axis", axis, AXES), jobs or count_available_cpus(), episode_s
    )
    with count_progress("episodes") as done:
        _, rows = run_benchmark(
            read_benchmark(path), open_dataset(dataset), PolicyName(policy, weights, title), out, settings, done.update
        )
    print(f"{sum(row.success for row in rows)} of {pluralize(len(rows), 'episode')} succeed; {out}")
    _print_reasons(rows)


@benchmark.command("score")
def score(
    results: Annotated[list[Path], typer.Argument(metavar="RESULTS…", help="Files of `benchmark run`.")],
    page: Annotated[
        Path | None,
        typer.Option("--page", metavar="FILE", callback=require_local_path, help="Also write a leaderboard, HTML."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print success rates by split, tier, relation and axis, with 95 % intervals.

    Example: `tableverse benchmark score planner.jsonl random.jsonl --page leaderboard.html`
    """
    from tableverse_factory.core.storage.files import write_atomic
    from tableverse_factory.evaluation.benchmark.leaderboard import name_policies, render_leaderboard
    from tableverse_factory.evaluation.benchmark.score import GROUP_NOTES, score_results

    if page is not None and page.resolve() in [path.resolve() for path in results]:
        raise ConfigError(f"--page {page}: it is one of the results, which the page would replace; give another file")
    found = score_results(results)
    if page is not None:
        write_atomic(page, render_leaderboard(found))
        print(page, file=sys.stderr)
    if as_json:
        print_json(_to_json(found))
        return
    for group, note in GROUP_NOTES.items():
        rows = [(row.name.replace("_", " "), *map(_format_rate, row.rates)) for row in found.rows if row.group == group]
        if rows:
            print_figures((group, *name_policies(found)), rows, f"success in %: {note}")
            print()
    for name, reasons in zip(name_policies(found), found.reasons, strict=True):
        print(f"{name}: {', '.join(f'{count} {reason}' for reason, count in reasons) or 'no failures'}")


def _print_reasons(rows: Sequence["EpisodeResult"]) -> None:
    """Print why episodes failed, the most frequent reasons, each with the detail that most of its episodes have."""
    from rich.console import Console

    counts = Counter(row.reason for row in rows if row.reason).most_common()
    if not counts:
        return
    table = make_table("reason", figures=["episodes"])
    table.add_column("for example", overflow="fold")
    for reason, count in counts[:MAX_REASONS]:
        detail = Counter(row.detail for row in rows if row.reason == reason).most_common(1)[0][0]
        example = next(row for row in rows if (row.reason, row.detail) == (reason, detail))
        table.add_row(reason, str(count), sanitize_line(f"{example.episode_id}{detail and ': '}{detail}", 400))
    Console(markup=False, emoji=False, highlight=False).print(table)
    if more := counts[MAX_REASONS:]:
        print(f"and {pluralize(sum(count for _, count in more), 'episode')} for {pluralize(len(more), 'other reason')}")


def _choose(option: str, given: list[str] | None, known: tuple[Name, ...]) -> tuple[Name, ...]:
    if wrong := [name for name in given or () if name not in known]:
        raise ConfigError(f"{option} {sanitize_line(wrong[0], 60)}: give one of {', '.join(known)}")
    return tuple(name for name in known if given is None or name in given)


def _format_rate(rate: "Rate | None") -> str:
    if rate is None:
        return "–"
    return f"{100 * rate.share:.1f} ({100 * rate.low:.0f}–{100 * rate.high:.0f}) of {rate.episodes}"


def _to_json(found: "Score") -> dict[str, object]:
    return {
        "benchmark": found.benchmark,
        "policies": [policy.model_dump(mode="json") for policy in found.policies],
        "rows": found.rows,
        "reasons": [dict(reasons) for reasons in found.reasons],
    }
