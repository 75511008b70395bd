"""Success rates of policies by split, tier, relation and axis, each with Wilson's 95 % interval."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.benchmark.benchmark import AXES, SPLITS, TIERS
from tableverse_factory.evaluation.benchmark.results import EpisodeResult, ResultsHeader, read_results
from tableverse_factory.evaluation.methods.collisions import compute_wilson_interval

Group = Literal["split", "tier", "relation", "axis"]
GROUP_NOTES: dict[Group, str] = {
    "split": "unperturbed episodes",
    "tier": "unperturbed episodes of unseen pictures",
    "relation": "unperturbed episodes of unseen pictures",
    "axis": "episodes of unseen pictures along each axis; none: those of them as they were exported",
}


@dataclass(frozen=True, slots=True)
class Rate:
    """Successes of some episodes, with Wilson's 95 % interval of their share."""

    episodes: int
    successes: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """Share of successes."""
        return self.successes / self.episodes


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """Rates of the policies, in their order; None where one has no such episode."""

    group: Group
    name: str
    rates: tuple[Rate | None, ...]


@dataclass(frozen=True, slots=True)
class Score:
    """Table of several policies on one benchmark."""

    benchmark: str  # digest
    policies: tuple[ResultsHeader, ...]
    rows: tuple[ScoreRow, ...]
    reasons: tuple[tuple[tuple[str, int], ...], ...]  # failures of each policy by reason, the most frequent first


def score_results(paths: Sequence[Path]) -> Score:
    """Score results files.

    Raises:
        InputError: `bad_results` for a file that is none, `other_results` if they are of different benchmarks.
    """
    read = [read_results(path) for path in paths]
    headers, results = [header for header, _ in read], [tuple(rows.values()) for _, rows in read]
    for path, header in zip(paths, headers, strict=True):
        if header.benchmark != headers[0].benchmark:
            raise InputError(
                f"{path} is of benchmark {header.benchmark[:12]}, and {paths[0]} of {headers[0].benchmark[:12]}: give "
                "results of one benchmark",
                "other_results",
            )
    chosen = [_group(rows) for rows in results]
    keys = [key for key in _order_keys(chosen) if any(key in groups for groups in chosen)]
    rows = tuple(ScoreRow(*key, tuple(_rate(groups.get(key, ())) for groups in chosen)) for key in keys)
    reasons = tuple(tuple(Counter(r.reason for r in each if r.reason).most_common()) for each in results)
    return Score(headers[0].benchmark, tuple(headers), rows, reasons)


def _group(results: Sequence[EpisodeResult]) -> dict[tuple[Group, str], list[EpisodeResult]]:
    """Group results; an episode is in several groups."""
    groups: dict[tuple[Group, str], list[EpisodeResult]] = {}
    repeated = {(row.scene_id, row.task_id) for row in results if row.axis != "none"}
    for row in results:
        keys: list[tuple[Group, str]] = []
        if row.axis == "none":
            keys.append(("split", row.split))
        if row.split == "test" and row.axis == "none":
            keys += [("tier", row.tier), ("relation", row.relation.value)]
        if row.split == "test" and (row.scene_id, row.task_id) in repeated:
            keys.append(("axis", row.axis))
        for key in keys:
            groups.setdefault(key, []).append(row)
    return groups


def _order_keys(chosen: Iterable[dict[tuple[Group, str], list[EpisodeResult]]]) -> list[tuple[Group, str]]:
    relations = sorted({name for groups in chosen for group, name in groups if group == "relation"})
    names: dict[Group, Sequence[str]] = {"split": SPLITS, "tier": TIERS, "relation": relations, "axis": AXES}
    return [(group, name) for group in GROUP_NOTES for name in names[group]]


def _rate(rows: Sequence[EpisodeResult]) -> Rate | None:
    if not rows:
        return None
    successes = sum(row.success for row in rows)
    return Rate(len(rows), successes, *compute_wilson_interval(successes / len(rows), len(rows)))
