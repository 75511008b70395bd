"""Tables 1 and 2 of the paper for a folder of results, as Markdown and JSON."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.evaluation.methods.ablation import find_ablation_scenes, list_configurations
from tableverse_factory.evaluation.methods.collisions import MethodCollisions, measure_method
from tableverse_factory.evaluation.methods.comparison import index_by_shared_name, match_methods
from tableverse_factory.evaluation.methods.grid_judges import replay_vote, summarize_recorded
from tableverse_factory.evaluation.methods.scenes import SceneSource
from tableverse_factory.evaluation.methods.score import (
    RefusedQuestion,
    VoteResults,
    ask_all,
    compute_results,
    format_interval,
)
from tableverse_factory.evaluation.methods.sources import MAX_METHODS, count_dropped_scenes, find_scenes
from tableverse_factory.evaluation.methods.vlm_vote import METRICS

ANSWERS = "answers"
OTHERS = frozenset({ANSWERS, "grids", "reference", "truth"})  # subfolders of the results that are not methods

ABSENT = "–"


@dataclass(frozen=True, slots=True)
class Tables:
    """Content of the two tables."""

    collisions: tuple[MethodCollisions, ...]  # of each method over all its own scenes
    shared: tuple[MethodCollisions, ...]  # over the scenes that could be measured for every method (table 1)
    votes: VoteResults | None  # the judge's marks; None without recorded answers
    ablation: Mapping[str, tuple[MethodCollisions, ...]]  # of each method that is one of our datasets (table 2)
    seed: int

    @property
    def complete(self) -> bool:
        """Whether every scene could be measured and every recorded answer is valid."""
        measured = (*self.collisions, *(each for its in self.ablation.values() for each in its))
        refused = self.votes is not None and bool(self.votes.refused)
        return not refused and not any(scene.error for each in measured for scene in each.scenes)


def make_tables(folder: Path, epsilon_m: float, seed: int, answers: Path | None, cache_dir: Path | None) -> Tables:
    """Measure every method in a folder of results.

    Args:
        folder: Folder with a subfolder for each method, and `answers` as `evaluate gpt-score` records them.
        epsilon_m: Depth beyond which objects collide [m].
        seed: Seed of the bootstrap.
        answers: Folder of recorded answers, if elsewhere.
        cache_dir: Cache of convex pieces; None measures only the meshes, as the paper does.
    """
    entries = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    methods = {entry.name: entry for entry in entries if entry.name not in OTHERS}
    if not methods:
        raise InputError(f"{folder}: no methods: give a folder with a subfolder for each", "no_methods")
    collisions = tuple(
        measure_method(name, _find_scenes_by_shared_name(path), epsilon_m, cache_dir, count_dropped_scenes(path))
        for name, path in methods.items()
    )
    recorded = answers or folder / ANSWERS
    ablation = {
        name: tuple(
            measure_method(row, find_ablation_scenes(path, poses), epsilon_m, cache_dir)
            for row, poses in list_configurations(path).items()
        )
        for name, path in methods.items()
        if (path / "run.json").is_file()
    }
    return Tables(collisions, _select_shared(collisions), _load_recorded_votes(methods, recorded, seed), ablation, seed)


def write_tables(tables: Tables, out: Path) -> tuple[Path, ...]:
    """Write table1.md, table2.md (if there is a dataset) and tables.json; return the paths."""
    files = {"table1.md": format_table_1(tables), "tables.json": json.dumps(tables_to_json(tables), indent=1) + "\n"}
    if tables.ablation:
        files["table2.md"] = format_table_2(tables)
    for name, text in sorted(files.items()):
        write_atomic(out / name, text.encode())
    return tuple(out / name for name in sorted(files))


def format_table_1(tables: Tables) -> str:
    """Format the comparison of methods."""
    marks = {} if tables.votes is None else compute_results(tables.votes, tables.seed)
    rows = []
    for own, each in zip(tables.collisions, tables.shared, strict=True):
        its = marks.get(each.method)
        scores = [ABSENT] * len(METRICS) if its is None else [format_interval(its[metric]) for metric in METRICS]
        scenes = f"{len(each.measured)} ({len(own.measured)})"
        dropped = ABSENT if own.dropped is None else str(own.dropped)
        rows.append([_escape_cell(each.method), scenes, dropped, _format_rate(each), *scores])
    head = ["Method", "Scenes", "Dropped", "Scene Collision Rate (%) ↓", "LF ↑", "VQ ↑", "GQ ↑", "Avg. Rank ↓"]
    note = "Rates are over the scenes that every method has; the number of the method's own scenes is in brackets.\n"
    if any(own.dropped for own in tables.collisions):
        note += "Dropped: scenes that the factory dropped. They count for no method.\n"
    return _format_markdown(head, rows) + _format_notes(tables) + note + _format_judge_note(tables.votes)


def format_table_2(tables: Tables) -> str:
    """Format the collisions left after each step of the factory."""
    rows = [
        [_escape_cell(name), each.method, str(len(each.measured)), _format_rate(each)]
        for name, its in tables.ablation.items()
        for each in its
    ]
    note = "\nExported scenes only: what the factory dropped is not among them.\n"
    head = ["Dataset", "Configuration", "Scenes", "Scene Collision Rate (%) ↓"]
    return _format_markdown(head, rows) + _format_notes(tables) + note


def tables_to_json(tables: Tables) -> dict[str, Any]:
    """Return both tables as plain values for JSON."""
    marks = {} if tables.votes is None else compute_results(tables.votes, tables.seed)
    shown = {
        method: {metric: asdict(interval) for metric, interval in by_metric.items()}
        for method, by_metric in marks.items()
    }
    return {
        "epsilon_m": tables.collisions[0].epsilon_m,
        "table1": [
            _list_rates(each)
            | {"own_scenes": len(own.scenes), "own_measured": len(own.measured), "own_collision_rate": own.rate()}
            | shown.get(each.method, dict.fromkeys(METRICS))
            for own, each in zip(tables.collisions, tables.shared, strict=True)
        ],
        "table2": [
            {"dataset": name, "configuration": each.method, **_list_rates(each)}
            for name, its in tables.ablation.items()
            for each in its
        ],
        "ballots": 0 if tables.votes is None else len(tables.votes.votes),
        "refused": [] if tables.votes is None else [refused.reason for refused in tables.votes.refused],
    }


def _find_scenes_by_shared_name(path: Path) -> list[SceneSource]:
    return [replace(source, name=name) for name, source in sorted(index_by_shared_name(find_scenes(path)).items())]


def _select_shared(collisions: Sequence[MethodCollisions]) -> tuple[MethodCollisions, ...]:
    """Select the scenes that could be measured for every method."""
    names = set.intersection(*({scene.name for scene in each.measured} for each in collisions))
    return tuple(replace(each, scenes=tuple(its for its in each.scenes if its.name in names)) for each in collisions)


def _load_recorded_votes(methods: Mapping[str, Path], folder: Path, seed: int) -> VoteResults | None:
    """Load all recorded answers about the methods that they name; None without any."""
    rounds, named = summarize_recorded(folder, MAX_METHODS)
    if not rounds:
        return None
    judged = {name: path for name, path in methods.items() if name in named}
    if unknown := sorted(named - set(judged)):
        reason = f"the answers name {', '.join(unknown)}"[:200] + ": there is no such method among the results"
        return VoteResults(tuple(judged), (), (RefusedQuestion("all scenes", 0, reason),))
    if not judged:
        return VoteResults((), (), (RefusedQuestion("all scenes", 0, "the answers name no method"),))
    return ask_all(match_methods(judged), partial(replay_vote, folder), min(rounds, len(judged)), seed)


def _list_rates(each: MethodCollisions) -> dict[str, Any]:
    return {key: value for key, value in each.as_json().items() if key != "per_scene"}


def _format_rate(each: MethodCollisions) -> str:
    rate, interval = each.rate(), each.interval()
    if rate is None or interval is None:
        return ABSENT
    return f"{100 * rate:.1f} ({100 * interval[0]:.0f}–{100 * interval[1]:.0f})"


def _format_notes(tables: Tables) -> str:
    epsilon = 1e3 * tables.collisions[0].epsilon_m
    lost = sum(len(each.scenes) - len(each.measured) for each in tables.collisions)
    text = f"\nA scene collides if the meshes of two objects overlap by more than {epsilon:g} mm. In brackets: 95 %.\n"
    return text + (f"{lost} scenes could not be measured and do not count.\n" if lost else "")


def _format_judge_note(votes: VoteResults | None) -> str:
    if votes is None or not votes.refused:
        return ""
    first = votes.refused[0]
    where = _escape_cell(f"{first.scene}, round {first.round}: {first.reason}"[:200], 200)
    return f"{len(votes.refused)} answers of the judge do not count, the first: {where}\n"


def _format_markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---", *("---:" for _ in head[1:])], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _escape_cell(text: str, most: int = 60) -> str:
    """Escape untrusted text for one cell of a table."""
    return sanitize_line(text, most).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")
