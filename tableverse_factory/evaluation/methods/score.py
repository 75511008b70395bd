"""The GPT-Score (paper, section 4 and table 1): means of a judge's marks over scenes, with bootstrap intervals."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from tableverse_factory.core.errors import ModelAccessError, TableverseError
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.evaluation.methods.comparison import Comparison
from tableverse_factory.evaluation.methods.grid import letters
from tableverse_factory.evaluation.methods.grid_judges import GridJudge, record
from tableverse_factory.evaluation.methods.vlm_vote import METRICS, Question, Vote, questions

RESAMPLES = 2000
MIN_SCENES = 5
"""Fewer scenes say nothing of how they spread."""

LOW, HIGH = 2.5, 97.5
"""Percentiles of the resampled means between which the true one lies with 95 % confidence."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean over scenes and its 95 % bootstrap interval, None where there are fewer than `MIN_SCENES`."""

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Refused:
    """A question without a ballot, and why."""

    scene: str
    round: int
    reason: str


@dataclass(frozen=True, slots=True)
class VoteResults:
    """All that was asked.

    Attributes:
        methods: In the order in which they were given.
        ballots: Those that count.
        refused: The rest.
    """

    methods: tuple[str, ...]
    ballots: tuple[Vote, ...]
    refused: tuple[Refused, ...]


def ask_all(
    comparison: Comparison,
    judge: GridJudge,
    rounds: int,
    seed: int,
    out: Path | None = None,
    watch: Callable[[Sequence[Question]], Iterable[Question]] = iter,
) -> VoteResults:
    """Asks the judge about every scene that all methods have, `rounds` times each.

    With a folder `out`, each grid that is looked at goes to `out/grids` and each ballot to `out/answers`, at once.

    Args:
        comparison: The methods.
        judge: Who is asked.
        rounds: Times each scene is asked about.
        seed: Of the order of columns.
        out: Folder to write to, or None.
        watch: Passes the questions on and shows how far they are.

    Raises:
        ModelAccessError: if asking further is of no use: no key, no credit.
    """
    ballots: list[Vote] = []
    refused: list[Refused] = []
    for question in watch(_all_questions(comparison, rounds, seed)):
        try:
            ballots.append(judge.vote(question, partial(_grid, comparison, question, out)))
        except ModelAccessError:
            raise
        except TableverseError as error:
            refused.append(Refused(question.scene, question.round, str(error)))
            continue
        if out is not None:
            record(ballots[-1], out / "answers")
    return VoteResults(comparison.methods, tuple(ballots), tuple(refused))


def write_grids(comparison: Comparison, rounds: int, seed: int, out: Path) -> int:
    """Writes every grid and asks nobody; returns how many.

    Raises:
        InputError: if a scene or its picture cannot be read.
    """
    asked = _all_questions(comparison, rounds, seed)
    for question in asked:
        _grid(comparison, question, out)
    return len(asked)


def _grid(comparison: Comparison, question: Question, out: Path | None) -> bytes:
    data = comparison.grid(question)
    if out is not None:
        write_atomic(out / "grids" / f"{question.name}.png", data)
    return data


def results(election: VoteResults, seed: int) -> dict[str, dict[str, Interval]]:
    """Means by method and metric (`METRICS`), over scenes; the same scenes are drawn for every method.

    Rounds of one scene are averaged first: they are not independent.
    """
    table = _scene_means(election)
    if not table.shape[0]:
        return {}
    rng = rng_for(seed, "bootstrap", "gpt-score")
    # How often each scene is drawn, not which: a matrix of counts, whatever the number of methods.
    counts = rng.multinomial(len(table), np.full(len(table), 1.0 / len(table)), RESAMPLES)
    resampled = (counts @ table.reshape(len(table), -1) / len(table)).reshape(RESAMPLES, *table.shape[1:])
    means, bounds = table.mean(axis=0), np.percentile(resampled, (LOW, HIGH), axis=0)
    enough = len(table) >= MIN_SCENES
    return {
        method: {
            metric: Interval(float(means[i, k]), *(map(float, bounds[:, i, k]) if enough else (None, None)))
            for k, metric in enumerate(METRICS)
        }
        for i, method in enumerate(election.methods)
    }


def rank_by_column(election: VoteResults) -> dict[str, float]:
    """Mean rank that each column got, whoever stood there: all alike where the judge minds no places."""
    found: dict[str, list[int]] = {letter: [] for letter in letters(len(election.methods))}
    for ballot in election.ballots:
        for letter, method in zip(found, ballot.columns, strict=True):
            found[letter].append(ballot.marks[method].rank)
    return {letter: float(np.mean(ranks)) for letter, ranks in found.items() if ranks}


def _all_questions(comparison: Comparison, rounds: int, seed: int) -> list[Question]:
    scenes = comparison.scenes
    return [question for scene in scenes for question in questions(scene, comparison.methods, rounds, seed)]


def _scene_means(election: VoteResults) -> Float64[np.ndarray, "s m 4"]:
    """Marks by scene, method and metric."""
    by_scene: dict[str, list[Vote]] = {}
    for ballot in election.ballots:
        by_scene.setdefault(ballot.scene, []).append(ballot)
    rows = [np.mean([_marks(ballot, election.methods) for ballot in its], axis=0) for its in by_scene.values()]
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(election.methods), len(METRICS))


def _marks(ballot: Vote, methods: Sequence[str]) -> list[list[float]]:
    return [[float(getattr(ballot.marks[method], metric)) for metric in METRICS] for method in methods]


def interval_text(value: Interval) -> str:
    """`7.14 (6.90–7.35)`, and `7.14` without an interval."""
    if value.low is None or value.high is None:
        return f"{value.mean:.2f}"
    return f"{value.mean:.2f} ({value.low:.2f}–{value.high:.2f})"


def as_json(election: VoteResults, seed: int) -> dict[str, object]:
    """What a script reads."""
    means: Mapping[str, Mapping[str, Interval]] = results(election, seed)
    return {
        "methods": {
            method: {metric: {"mean": its.mean, "low": its.low, "high": its.high} for metric, its in by_metric.items()}
            for method, by_metric in means.items()
        },
        "scenes": len({ballot.scene for ballot in election.ballots}),
        "ballots": len(election.ballots),
        "rank_by_column": rank_by_column(election),
        "refused": [{"scene": r.scene, "round": r.round, "reason": r.reason} for r in election.refused],
        "seed": seed,
        "resamples": RESAMPLES,
    }
