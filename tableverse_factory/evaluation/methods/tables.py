"""The paper's tables 1 and 2 for a folder of results, as Markdown and JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.evaluation.methods.ablation import ablation_sources, configurations
from tableverse_factory.evaluation.methods.collisions import MethodCollisions, measure_method
from tableverse_factory.evaluation.methods.comparison import compare, shared_names
from tableverse_factory.evaluation.methods.grid_judges import ReplayedJudge, recorded_questions
from tableverse_factory.evaluation.methods.methods import MAX_METHODS
from tableverse_factory.evaluation.methods.scenes import Source
from tableverse_factory.evaluation.methods.score import Interval, Refused, VoteResults, ask_all, interval_text, results
from tableverse_factory.evaluation.methods.sources import dropped_scenes, find_scenes
from tableverse_factory.evaluation.methods.vlm_vote import METRICS

ANSWERS = "answers"
OTHERS = frozenset({ANSWERS, "grids", "reference", "truth"})
"""Subfolders of the results that are no methods."""

ABSENT = "–"


@dataclass(frozen=True, slots=True)
class Tables:
    """What the two tables hold.

    Attributes:
        collisions: Of each method, over all its own scenes.
        shared: The same over the scenes that could be measured for every method (table 1).
        election: The judge's marks; None where nothing is recorded.
        ablation: For each method that is one of our datasets, its configurations (table 2).
    """

    collisions: tuple[MethodCollisions, ...]
    shared: tuple[MethodCollisions, ...]
    election: VoteResults | None
    ablation: Mapping[str, tuple[MethodCollisions, ...]]
    seed: int

    @property
    def complete(self) -> bool:
        """Whether every scene could be measured and every recorded answer counts."""
        measured = (*self.collisions, *(each for its in self.ablation.values() for each in its))
        refused = self.election is not None and bool(self.election.refused)
        return not refused and not any(scene.error for each in measured for scene in each.scenes)


def make_tables(folder: Path, epsilon_m: float, seed: int, answers: Path | None, cache_dir: Path | None) -> Tables:
    """Measures every method in a folder of results.

    Args:
        folder: Holds a subfolder for each method; also `answers`, as `evaluate gpt-score` records them.
        epsilon_m: Overlaps up to this depth are no collision [m].
        seed: Of the bootstrap.
        answers: Recorded answers elsewhere.
        cache_dir: For convex pieces; None measures the meshes alone, as the paper's table does.

    Raises:
        InputError: if there is no method, or one has no scenes.
    """
    methods = {entry.name: entry for entry in sorted(folder.iterdir()) if _is_method(entry)}
    if not methods:
        raise InputError(f"{folder}: no methods: give a folder with a subfolder for each", "no_methods")
    collisions = tuple(
        measure_method(name, _by_shared_name(path), epsilon_m, cache_dir, dropped_scenes(path))
        for name, path in methods.items()
    )
    recorded = answers or folder / ANSWERS
    ablation = {
        name: tuple(
            measure_method(row, ablation_sources(path, poses), epsilon_m, cache_dir)
            for row, poses in configurations(path).items()
        )
        for name, path in methods.items()
        if (path / "run.json").is_file()
    }
    return Tables(collisions, _shared(collisions), _recorded(methods, recorded, seed), ablation, seed)


def write_tables(tables: Tables, out: Path) -> tuple[Path, ...]:
    """Writes table1.md, table2.md (where there is a dataset) and tables.json; returns the paths."""
    files = {"table1.md": table_1(tables), "tables.json": json.dumps(as_json(tables), indent=1) + "\n"}
    if tables.ablation:
        files["table2.md"] = table_2(tables)
    for name, text in sorted(files.items()):
        write_atomic(out / name, text.encode())
    return tuple(out / name for name in sorted(files))


def table_1(tables: Tables) -> str:
    """Methods against one another."""
    marks = {} if tables.election is None else results(tables.election, tables.seed)
    rows = []
    for own, each in zip(tables.collisions, tables.shared, strict=True):
        its = marks.get(each.method)
        scores = [ABSENT] * len(METRICS) if its is None else [interval_text(its[metric]) for metric in METRICS]
        scenes = f"{len(each.measured)} ({len(own.measured)})"
        dropped = ABSENT if own.dropped is None else str(own.dropped)
        rows.append([_cell(each.method), scenes, dropped, _rate(each), *scores])
    head = ["Method", "Scenes", "Dropped", "Scene Collision Rate (%) ↓", "LF ↑", "VQ ↑", "GQ ↑", "Avg. Rank ↓"]
    note = "Rates are over the scenes that every method has; in brackets after their count: the method's own.\n"
    if any(own.dropped for own in tables.collisions):
        note += "Dropped: scenes that the factory gave up. They count for no method.\n"
    return _markdown(head, rows) + _notes(tables) + note + _judge_note(tables.election)


def table_2(tables: Tables) -> str:
    """What each step of the factory leaves of the collisions."""
    rows = [
        [_cell(name), each.method, str(len(each.measured)), _rate(each)]
        for name, its in tables.ablation.items()
        for each in its
    ]
    note = "\nExported scenes only: what the factory dropped is not among them.\n"
    head = ["Dataset", "Configuration", "Scenes", "Scene Collision Rate (%) ↓"]
    return _markdown(head, rows) + _notes(tables) + note


def as_json(tables: Tables) -> dict[str, Any]:
    """Both tables as a script reads them."""
    marks: Mapping[str, Mapping[str, Interval]] = (
        {} if tables.election is None else results(tables.election, tables.seed)
    )
    return {
        "epsilon_m": tables.collisions[0].epsilon_m,
        "table1": [
            _rates(each)
            | {"own_scenes": len(own.scenes), "own_measured": len(own.measured), "own_collision_rate": own.rate()}
            | {metric: _interval(marks.get(each.method, {}).get(metric)) for metric in METRICS}
            for own, each in zip(tables.collisions, tables.shared, strict=True)
        ],
        "table2": [
            {"dataset": name, "configuration": each.method, **_rates(each)}
            for name, its in tables.ablation.items()
            for each in its
        ],
        "ballots": 0 if tables.election is None else len(tables.election.ballots),
        "refused": [] if tables.election is None else [refused.reason for refused in tables.election.refused],
    }


def _is_method(entry: Path) -> bool:
    return entry.is_dir() and entry.name not in OTHERS and not entry.name.startswith(".")


def _by_shared_name(path: Path) -> list[Source]:
    return [replace(source, name=name) for name, source in sorted(shared_names(find_scenes(path)).items())]


def _shared(collisions: Sequence[MethodCollisions]) -> tuple[MethodCollisions, ...]:
    """Each method over the scenes that could be measured for all."""
    names = set.intersection(*({scene.name for scene in each.measured} for each in collisions))
    return tuple(replace(each, scenes=tuple(its for its in each.scenes if its.name in names)) for each in collisions)


def _recorded(methods: Mapping[str, Path], folder: Path, seed: int) -> VoteResults | None:
    """The answers that lie there, all rounds, about the methods that they name; None without any."""
    rounds, named = recorded_questions(folder, MAX_METHODS)
    if not rounds:
        return None
    judged = {name: path for name, path in methods.items() if name in named}
    if strangers := sorted(named - set(judged)):
        reason = f"the answers name {', '.join(strangers)}"[:200] + ": there is no such method among the results"
        return VoteResults(tuple(judged), (), (Refused("all scenes", 0, reason),))
    if not judged:
        return VoteResults((), (), (Refused("all scenes", 0, "the answers name no method"),))
    return ask_all(compare(judged), ReplayedJudge(folder), min(rounds, len(judged)), seed)


def _rates(each: MethodCollisions) -> dict[str, Any]:
    return {key: value for key, value in each.as_json().items() if key != "per_scene"}


def _interval(value: Interval | None) -> dict[str, float | None] | None:
    return None if value is None else {"mean": value.mean, "low": value.low, "high": value.high}


def _rate(each: MethodCollisions) -> str:
    rate, interval = each.rate(), each.interval()
    if rate is None or interval is None:
        return ABSENT
    return f"{100 * rate:.1f} ({100 * interval[0]:.0f}–{100 * interval[1]:.0f})"


def _notes(tables: Tables) -> str:
    epsilon = 1e3 * tables.collisions[0].epsilon_m
    lost = sum(len(each.scenes) - len(each.measured) for each in tables.collisions)
    text = f"\nA scene collides if the meshes of two objects overlap by more than {epsilon:g} mm. In brackets: 95 %.\n"
    return text + (f"{lost} scenes could not be measured and do not count.\n" if lost else "")


def _judge_note(election: VoteResults | None) -> str:
    if election is None or not election.refused:
        return ""
    first = election.refused[0]
    where = _cell(f"{first.scene}, round {first.round}: {first.reason}"[:200], 200)
    return f"{len(election.refused)} answers of the judge do not count, the first: {where}\n"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---", *("---:" for _ in head[1:])], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(text: str, most: int = 60) -> str:
    """A text that somebody else chose, in one cell of a table."""
    return sanitize_line(text, most).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")
