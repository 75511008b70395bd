"""Splits of tasks: by picture, and by the nouns of what is carried and of the reference."""

import hashlib
import re
from collections.abc import Iterable, Mapping
from typing import Any

from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import get_split
from tableverse_factory.delivery.learning.dataset_environment import list_solved_tasks
from tableverse_factory.evaluation.benchmark.benchmark import Split
from tableverse_factory.stages.curate.lexicon import find_head_noun, unify_noun

HELD_OUT_SHARE = 0.15
"""Expected share of nouns that are held out."""

_RELATIONS = re.compile(r" (?:in|on|next to) ")  # of phrases, as `curate.phrases` has them
_PLACES = re.compile(r" (?:nearest to|farthest from|from) the (?:camera|left)")

Row = Mapping[str, Any]


def find_noun(row: Row) -> str:
    """Find the noun of a row of objects/; nouns that may name the same thing are one."""
    return unify_noun(find_head_noun(str(row["relabel_name"] or row["label"])))


def is_held_out(noun: str) -> bool:
    """Return whether a noun is held out of training: its hash decides, so it stays so however a dataset grows."""
    return int(hashlib.sha256(f"held out {noun}".encode()).hexdigest()[:8], 16) / 2**32 < HELD_OUT_SHARE


def select_known_phrases(phrases: Iterable[str]) -> tuple[str, ...]:
    """Select the phrases without a held-out noun, of the object or of one that it is said to stand by."""
    return tuple(phrase for phrase in phrases if not any(map(is_held_out, _list_nouns(phrase))))


def _list_nouns(phrase: str) -> list[str]:
    return [unify_noun(find_head_noun(part)) for part in _RELATIONS.split(_PLACES.sub("", phrase))]


def find_task_split(scene_row: Row, nouns: tuple[str, str]) -> Split | None:
    """Find the split of a task from its scene's row, and the nouns of what is carried and of the reference.

    A held-out noun makes a task of the test split one of `unseen_kinds`, and leaves out one of another: None.
    """
    split = get_split(scene_row)
    if any(map(is_held_out, nouns)):
        return "unseen_kinds" if split == "test" else None
    return split  # type: ignore[return-value]


def list_split_tasks(dataset: Dataset, robot: str = "panda") -> dict[tuple[str, str], Split]:
    """List the split of every task that a recorded motion of `robot` solves, by ids of scene and task.

    Policies train on those of `train` alone, and stop by those of `validation`. Tasks that carry or refer to a
    held-out noun are absent, or `unseen_kinds`; such a thing may stand by in any scene.
    """
    solved = set(list_solved_tasks(dataset, None, robot))
    scenes = {row["scene_id"]: row for row in dataset.scenes.to_table(columns=["scene_id", "split"]).to_pylist()}
    names = dataset.objects.to_table(columns=["scene_id", "object_id", "label", "relabel_name"]).to_pylist()
    nouns = {(row["scene_id"], row["object_id"]): find_noun(row) for row in names}
    found: dict[tuple[str, str], Split] = {}
    for row in dataset.tasks.to_table(columns=["scene_id", "task_id", "x_id", "y_id"]).to_pylist():
        scene_id = row["scene_id"]
        if (scene_id, row["task_id"]) in solved:
            both = nouns[scene_id, row["x_id"]], nouns[scene_id, row["y_id"]]
            if (split := find_task_split(scenes[scene_id], both)) is not None:
                found[scene_id, row["task_id"]] = split
    return dict(sorted(found.items()))
