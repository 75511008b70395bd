"""Manifest of cousins: for each finished scene of a dataset, rows that say what is to be changed, and a digest.

Only tables are read. What becomes of the changes is decided where the scene's shapes are read, by
`stages.cousins`.
"""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.cousins import MAX_DONORS, Change, Donor, Recipe
from schemas.identity import content_hash
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.text import pluralize
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import find_split

Row = Mapping[str, Any]

THEMES: Sequence[tuple[Change, ...]] = (  # each cousin of a scene takes the next one; things move in all of them
    (Change.MOVE, Change.TURN),
    (Change.SWAP, Change.MOVE),
    (Change.SCALE, Change.MOVE),
    (Change.REMOVE, Change.MOVE),
    (Change.MOVE, Change.MIRROR),
    (Change.SWAP, Change.MOVE, Change.TURN),
    (Change.SCALE, Change.MOVE, Change.MIRROR),
    (Change.REMOVE, Change.SWAP, Change.MOVE),
    (Change.SCALE, Change.MOVE, Change.TURN),
    (Change.SWAP, Change.MOVE, Change.MIRROR),
)
DONORS_PER_OBJECT = 3
DIGEST_CHARS = 12
LEAST_SHAPE_RATIO = 1.02  # between the ratios of two things' sides: below, they may be the same thing
MAX_SIZE_RATIO = 1.6  # of each side, sorted, of things that may take each other's place
_SCENE_COLUMNS = ("scene_id", "name", "url", "source", "licence", "family", "status", "shard", "mesh_licences")
_POSES = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
_SIDES = ("size_x_m", "size_y_m", "size_z_m")
_OBJECT_COLUMNS = (
    *("scene_id", "object_id", "label", "relabel_name", "contained_in", "n_pieces", "mass_kg"),
    *(*_SIDES, *_POSES),
)


@dataclass(frozen=True, slots=True)
class _Stock:
    """Objects of a split and kind, with their scenes (n,), and their sides in ascending order (n, 3) [m]."""

    rows: Sequence[Row]
    scenes: np.ndarray
    sides: np.ndarray


def list_cousins(dataset: Dataset, per_scene: int, seed: int, classify: Callable[[str], str]) -> Iterator[ImageRow]:
    """List the rows of cousins of each finished scene, in the dataset's order.

    The same dataset and seed give the same rows, and the cousins of a scene do not depend on how many there are.

    Args:
        dataset: The parents' dataset.
        per_scene: Number of cousins of each scene.
        seed: Of the choice of donors, and of all that is drawn later.
        classify: Gives the kind of a thing by its name; only things of a kind are swapped.

    Raises:
        InputError: if the dataset is not finished, or no scene of it is done.
    """
    _check_finished(dataset)
    scenes = dataset.scenes.to_table(columns=list(_SCENE_COLUMNS)).to_pylist()
    done = [row for row in scenes if row["status"] == "done"]
    if not done:
        raise InputError(f"{dataset.path}: none of {pluralize(len(scenes), 'scene')} is done: cousins have no parents")
    family_of = {row["scene_id"]: row["family"] or row["scene_id"] for row in done}
    objects: dict[str, list[Row]] = defaultdict(list)
    for item in dataset.objects.to_table(columns=list(_OBJECT_COLUMNS)).to_pylist():
        objects[item["scene_id"]].append({**item, "kind": classify(item["relabel_name"] or item["label"])})
    stocks = _stock_objects(objects, family_of)
    digests = {scene_id: digest_objects(objects[scene_id]) for scene_id in family_of}
    for row in done:
        scene_id = row["scene_id"]
        candidates = _find_candidates(objects[scene_id], stocks, find_split(family_of[scene_id]))
        for index in range(per_scene):
            rng = make_rng(seed, scene_id, f"cousin {index}")
            donors = _choose_donors(candidates, rng)
            identity = f"{scene_id} {index} {seed}"
            yield _make_row(dataset.path, row, family_of[scene_id], index, donors, digests[scene_id], identity)


def digest_objects(rows: Iterable[Row]) -> str:
    """Hash what the tables say of objects: ids, labels, sizes and poses. A scene that was built anew differs."""
    values = [[row[name] for name in _OBJECT_COLUMNS] for row in rows]
    return content_hash(json.dumps(values, separators=(",", ":")).encode())


def _check_finished(dataset: Dataset) -> None:
    run = dataset.record()
    if run is None:
        raise InputError(f"{dataset.path}: no run.json, so nothing says whether it is finished")
    known = dataset.scenes.count_rows()
    if "published" not in run and known != run["manifest"]["scenes"]:
        raise InputError(
            f"{dataset.path} is not finished: {known} of {pluralize(run['manifest']['scenes'], 'scene')} have a row: "
            "finish it with `tableverse build MANIFEST OUT` first"
        )


def _stock_objects(
    objects: Mapping[str, Sequence[Row]], family_of: Mapping[str, str]
) -> Mapping[tuple[str, str], _Stock]:
    """Sort what stands freely by split and kind."""
    found: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for scene_id, family in family_of.items():
        for item in objects[scene_id]:
            if item["contained_in"] is None:
                found[find_split(family), item["kind"]].append(item)
    return {
        key: _Stock(rows, np.array([row["scene_id"] for row in rows]), np.array([_sort_sides(row) for row in rows]))
        for key, rows in found.items()
    }


def _sort_sides(row: Row) -> list[float]:
    return sorted(float(row[name]) for name in _SIDES)


def _find_candidates(
    objects: Sequence[Row], stocks: Mapping[tuple[str, str], _Stock], split: str
) -> list[tuple[Row, _Stock, np.ndarray]]:
    """Find what may replace each object: of its kind, about as large, of another shape, from another scene."""
    found = []
    for item in objects:
        stock = stocks.get((split, item["kind"]))
        if stock is None or item["contained_in"] is not None:
            continue
        ratio = stock.sides / np.array(_sort_sides(item))
        like = np.maximum(ratio, 1 / ratio).max(axis=1) <= MAX_SIZE_RATIO
        other = ratio.max(axis=1) / ratio.min(axis=1) >= LEAST_SHAPE_RATIO
        places = np.flatnonzero(like & other & (stock.scenes != item["scene_id"]))
        if len(places):
            found.append((item, stock, places))
    return found


def _choose_donors(candidates: Sequence[tuple[Row, _Stock, np.ndarray]], rng: np.random.Generator) -> tuple[Donor, ...]:
    """Choose donors at random for as many objects as a recipe holds, each donor for one of them."""
    chosen: dict[tuple[str, str], Donor] = {}
    for number in rng.permutation(len(candidates)).tolist():
        item, stock, places = candidates[number]
        for place in rng.choice(places, min(DONORS_PER_OBJECT, len(places)), replace=False).tolist():
            row = stock.rows[place]
            where = {"scene_id": row["scene_id"], "object_id": row["object_id"]}
            donor = Donor(replaces=item["object_id"], digest=digest_objects([row])[:DIGEST_CHARS], **where)
            chosen.setdefault((donor.scene_id, donor.object_id), donor)
        if len(chosen) + DONORS_PER_OBJECT > MAX_DONORS:
            break
    return tuple(chosen.values())


def _make_row(
    path: str,
    parent: Row,
    family: str,
    index: int,
    donors: tuple[Donor, ...],
    digest: str,
    identity: str,
) -> ImageRow:
    theme = THEMES[index % len(THEMES)]
    if not donors:
        theme = tuple(dict.fromkeys(Change.TURN if change is Change.SWAP else change for change in theme))
    recipe = Recipe(changes=theme, donors=donors if Change.SWAP in theme else ())
    text = recipe.model_dump_json(exclude_defaults=True)
    own = content_hash(digest.encode(), text.encode(), identity.encode())
    name = f"{_name_parent(parent)}-c{index:02d}"
    return ImageRow(
        scene_id=f"{re.sub(r'[^A-Za-z0-9_]+', '-', name)[-60:].strip('-_')}-{own[:12]}",
        kind=SceneKind.COUSIN,
        uri=path,
        name=name,
        content_sha256=digest,
        url=parent["url"] or "",
        source=parent["source"] or "",
        licence=parent["licence"] or "",
        parent=parent["scene_id"],
        family=family,
        recipe=text,
    )


def _name_parent(parent: Row) -> str:
    name = str(parent["name"] or parent["scene_id"])
    return re.sub(r"\.(json|jpe?g|png|webp)$", "", name)[:200]
