"""The paper's tables 1 and 2 for a folder of results, as Markdown and JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.errors import InputError
from tableverse_factory.evaluate.ablation import CONFIGURATIONS, ablation_sources
from tableverse_factory.evaluate.ballots import METRICS
from tableverse_factory.evaluate.collisions import MethodCollisions, measure_method
from tableverse_factory.evaluate.comparison import compare
from tableverse_factory.evaluate.grid_judges import ReplayedJudge
from tableverse_factory.evaluate.score import Election, Interval, ask_all, interval_text, results
from tableverse_factory.evaluate.sources import find_scenes
from tableverse_factory.storage import write_atomic
from tableverse_factory.text import printable

ANSWERS = "answers"
OTHERS = frozenset({ANSWERS, "grids", "reference", "truth"})
"""Subfolders of the results that are no methods."""

ABSENT = "–"


@dataclass(frozen=True, slots=True)
class Tables:
    """What the two tables hold.

    Attributes:
        collisions: Of each method (table 1).
        election: The judge's marks; None where nothing is recorded.
        ablation: For each method that is one of our datasets, its configurations (table 2).
    """

    collisions: tuple[MethodCollisions, ...]
    election: Election | None
    ablation: Mapping[str, tuple[MethodCollisions, ...]]
    seed: int


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
    collisions = [measure_method(name, find_scenes(path), epsilon_m, cache_dir) for name, path in methods.items()]
    recorded = answers or folder / ANSWERS
    ablation = {
        name: tuple(
            measure_method(row, ablation_sources(path, poses), epsilon_m, cache_dir)
            for row, poses in CONFIGURATIONS.items()
        )
        for name, path in methods.items()
        if (path / "run.json").is_file()
    }
    return Tables(tuple(collisions), _recorded(methods, recorded, seed), ablation, seed)


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
    for each in tables.collisions:
        its = marks.get(each.method)
        scores = [ABSENT] * len(METRICS) if its is None else [interval_text(its[metric]) for metric in METRICS]
        rows.append([_cell(each.method), str(len(each.measured)), _rate(each), *scores])
    head = ["Method", "Scenes", "Scene Collision Rate (%) ↓", "LF ↑", "VQ ↑", "GQ ↑", "Avg. Rank ↓"]
    return _markdown(head, rows) + _notes(tables)


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
            _rates(each) | {metric: _interval(marks.get(each.method, {}).get(metric)) for metric in METRICS}
            for each in tables.collisions
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


def _recorded(methods: Mapping[str, Path], folder: Path, seed: int) -> Election | None:
    """The answers that lie there, all rounds; None without any."""
    rounds = [int(path.stem.rpartition("-")[2]) for path in folder.glob("*-[0-9]*.json") if _numbered(path)]
    if not rounds:
        return None
    return ask_all(compare(methods), ReplayedJudge(folder), max(rounds) + 1, seed)


def _numbered(path: Path) -> bool:
    return path.stem.rpartition("-")[2].isdecimal()


def _rates(each: MethodCollisions) -> dict[str, Any]:
    return {key: value for key, value in each.as_json().items() if key != "per_scene"}


def _interval(value: Interval | None) -> dict[str, float] | None:
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


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---", *("---:" for _ in head[1:])], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _cell(text: str) -> str:
    """A name that somebody else chose, in one cell of a table."""
    return printable(text, 60).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")
