"""GPT-Score (paper, section 4 and table 1): means of a judge's marks over scenes with bootstrap intervals."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from tableverse_factory.core.errors import ModelAccessError, TableverseError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.evaluation.methods.comparison import Comparison
from tableverse_factory.evaluation.methods.grid import make_letters
from tableverse_factory.evaluation.methods.grid_judges import GridJudge, record_vote
from tableverse_factory.evaluation.methods.vlm_vote import METRICS, Question, Vote, make_questions

RESAMPLES = 2000
MIN_SCENES = 5  # least scenes for an interval

LOW, HIGH = 2.5, 97.5  # percentiles of the resampled means that bound the 95 % interval


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean over scenes and its 95 % bootstrap interval; None for fewer than `MIN_SCENES` scenes."""

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class RefusedQuestion:
    """A question without a valid answer, and the reason."""

    scene: str
    round: int
    reason: str


@dataclass(frozen=True, slots=True)
class VoteResults:
    """Results of all questions: the methods in the given order, valid votes, and refused questions."""

    methods: tuple[str, ...]
    votes: tuple[Vote, ...]
    refused: tuple[RefusedQuestion, ...]


def ask_all(
    comparison: Comparison,
    judge: GridJudge,
    rounds: int,
    seed: int,
    out: Path | None = None,
    watch: Callable[[Sequence[Question]], Iterable[Question]] = iter,
) -> VoteResults:
    """Ask the judge about every scene that all methods have, `rounds` times each.

    With a folder `out`, each grid is written to `out/grids` and each vote to `out/answers` at once. `watch` passes the
    questions on and shows progress.

    Raises:
        ModelAccessError: if further questions are pointless: no key, no credit.
    """
    answered: list[Vote] = []
    refused: list[RefusedQuestion] = []
    for question in watch(_list_questions(comparison, rounds, seed)):
        try:
            answered.append(judge(question, partial(_draw_grid, comparison, question, out)))
        except ModelAccessError:
            raise
        except TableverseError as error:
            refused.append(RefusedQuestion(question.scene, question.round, str(error)))
            continue
        if out is not None:
            record_vote(answered[-1], out / "answers")
    return VoteResults(comparison.methods, tuple(answered), tuple(refused))


def write_grids(comparison: Comparison, rounds: int, seed: int, out: Path) -> int:
    """Write every grid without asking a judge; return their number."""
    asked = _list_questions(comparison, rounds, seed)
    for question in asked:
        _draw_grid(comparison, question, out)
    return len(asked)


def _draw_grid(comparison: Comparison, question: Question, out: Path | None) -> bytes:
    data = comparison.grid(question)
    if out is not None:
        write_atomic(out / "grids" / f"{question.name}.png", data)
    return data


def compute_results(votes: VoteResults, seed: int) -> dict[str, dict[str, Interval]]:
    """Compute means by method and metric (`METRICS`) over scenes, resampling the same scenes for every method.

    Rounds of one scene are averaged first, as they are not independent.
    """
    table = _compute_scene_means(votes)
    if not table.shape[0]:
        return {}
    rng = make_rng(seed, "bootstrap", "gpt-score")
    # Counts of draws per scene, one matrix for all methods.
    counts = rng.multinomial(len(table), np.full(len(table), 1.0 / len(table)), RESAMPLES)
    resampled = (counts @ table.reshape(len(table), -1) / len(table)).reshape(RESAMPLES, *table.shape[1:])
    means, bounds = table.mean(axis=0), np.percentile(resampled, (LOW, HIGH), axis=0)
    enough = len(table) >= MIN_SCENES
    return {
        method: {
            metric: Interval(float(means[i, k]), *(map(float, bounds[:, i, k]) if enough else (None, None)))
            for k, metric in enumerate(METRICS)
        }
        for i, method in enumerate(votes.methods)
    }


def compute_rank_by_column(votes: VoteResults) -> dict[str, float]:
    """Compute the mean rank of each column over all methods; they are alike for a judge without position bias."""
    found: dict[str, list[int]] = {letter: [] for letter in make_letters(len(votes.methods))}
    for vote in votes.votes:
        for letter, method in zip(found, vote.columns, strict=True):
            found[letter].append(vote.marks[method].rank)
    return {letter: float(np.mean(ranks)) for letter, ranks in found.items() if ranks}


def _list_questions(comparison: Comparison, rounds: int, seed: int) -> list[Question]:
    scenes = comparison.scenes
    return [question for scene in scenes for question in make_questions(scene, comparison.methods, rounds, seed)]


def _compute_scene_means(votes: VoteResults) -> Float64[np.ndarray, "s m 4"]:
    """Compute mean marks by scene, method and metric."""
    by_scene: dict[str, list[Vote]] = {}
    for vote in votes.votes:
        by_scene.setdefault(vote.scene, []).append(vote)
    rows = [np.mean([_list_marks(vote, votes.methods) for vote in its], axis=0) for its in by_scene.values()]
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(votes.methods), len(METRICS))


def _list_marks(vote: Vote, methods: Sequence[str]) -> list[list[float]]:
    return [[float(getattr(vote.marks[method], metric)) for metric in METRICS] for method in methods]


def format_interval(value: Interval) -> str:
    """Format `7.14 (6.90–7.35)`, or `7.14` without an interval."""
    if value.low is None or value.high is None:
        return f"{value.mean:.2f}"
    return f"{value.mean:.2f} ({value.low:.2f}–{value.high:.2f})"


def results_to_json(votes: VoteResults, seed: int) -> dict[str, object]:
    """Return plain values for JSON."""
    return {
        "methods": {
            method: {metric: asdict(its) for metric, its in by_metric.items()}
            for method, by_metric in compute_results(votes, seed).items()
        },
        "scenes": len({vote.scene for vote in votes.votes}),
        "ballots": len(votes.votes),
        "rank_by_column": compute_rank_by_column(votes),
        "refused": [asdict(refused) for refused in votes.refused],
        "seed": seed,
        "resamples": RESAMPLES,
    }
