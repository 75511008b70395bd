"""First stage of cousins: a finished scene of a dataset, changed as the recipe says where there is room."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from schemas.config import Config, ObserveConfig
from schemas.cousins import Change, Donor, Recipe, parse_recipe
from schemas.manifest import ImageRow
from schemas.objects import PlacedObject, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.cousin_rows import DIGEST_CHARS, digest_objects
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.models.services import Services
from tableverse_factory.stages.cousins.arrangement import Arrangement
from tableverse_factory.stages.cousins.changes import Draft
from tableverse_factory.stages.cousins.parent import ParentScene, read_parent, read_scene_object
from tableverse_factory.stages.cousins.reflection import mirror_object

Row = Mapping[str, Any]

_DROPPED_FOR = frozenset({"bad_recipe", "content_changed"})

_open = lru_cache(2)(open_dataset)  # its index of scenes is read once in a process


def derive_cousin(
    item: ImageRow,
    config: Config,
    rng: np.random.Generator,
    services: Services,  # noqa: ARG001
) -> Outcome[PlacedObjects]:
    """Change a scene of a dataset; the later stages separate, settle, judge and certify it like any other layout.

    Drops: `content_changed` if the dataset is not the one that the manifest saw, `no_room` if nothing could be changed,
    `bad_recipe` if the row has none.

    Raises:
        InputError, GeometryError: if files of the parent or of a donor are damaged or gone, which fails the cousin:
            once they are restored, it can be retried.
    """
    if item.rejected:
        return Dropped(item.rejected, item.rejected_detail)
    try:
        recipe = _read_recipe(item)
        parent = _read_parent(item.uri, item.parent, item.content_sha256, config.observe)
        donors = _list_donors(_open(item.uri), recipe, config.observe)
        draft = Draft(Arrangement(parent.objects, parent.table), rng, donors)
        for change in recipe.changes:
            if change is not Change.MIRROR:
                draft.make(change)
        draft.fill()
    except InputError as error:
        if error.reason not in _DROPPED_FOR:
            raise
        return Dropped(error.reason, str(error))
    objects = tuple(draft.arrangement.objects.values())
    if Change.MIRROR in recipe.changes:
        objects = tuple(mirror_object(thing, parent.table) for thing in objects)
        draft.changes.append(Change.MIRROR.value)
    if not draft.changes:
        return Dropped("no_room", f"on the table of {item.parent} for any of: {', '.join(recipe.changes)}")
    return Done(
        PlacedObjects(item.scene_id, parent.table, objects, perception=parent.perception, changes=tuple(draft.changes))
    )


@lru_cache(2)  # a worker makes the cousins of a scene one after the other
def _read_parent(uri: str, scene_id: str, digest: str, bounds: ObserveConfig) -> ParentScene:
    scene = _open(uri).scene(scene_id)
    _check_content(uri, digest, scene.object_rows())
    return read_parent(scene, bounds)


def _read_recipe(item: ImageRow) -> Recipe:
    if not item.parent:
        raise InputError("a cousin's row names its parent: `tableverse cousins` writes such rows", "bad_recipe")
    try:
        return parse_recipe(item.recipe)
    except ValueError as error:
        raise InputError(f"{error}: `tableverse cousins` writes recipes", "bad_recipe") from error


def _check_content(uri: str, digest: str, rows: Sequence[Row]) -> None:
    """Compare what the tables say of objects with what they said when the cousin was planned."""
    if not (found := digest_objects(rows)).startswith(digest):
        change = f"sha256 {found[:DIGEST_CHARS]}, not {digest[:DIGEST_CHARS]}"
        problem = f"{uri} is not the dataset that was planned with ({change}): run tableverse cousins again"
        raise InputError(problem, "content_changed")


def _list_donors(
    dataset: Dataset, recipe: Recipe, bounds: ObserveConfig
) -> dict[str, list[tuple[str, Callable[[], PlacedObject]]]]:
    """List the readers of things that may replace an object, by its id; they are read when they are tried."""
    found: dict[str, list[tuple[str, Callable[[], PlacedObject]]]] = {}
    for donor in recipe.donors:
        read = partial(_read_donor, dataset, donor, bounds)
        found.setdefault(donor.replaces, []).append((f"{donor.scene_id}/{donor.object_id}", read))
    return found


def _read_donor(dataset: Dataset, donor: Donor, bounds: ObserveConfig) -> PlacedObject:
    """Read an object of another scene; without a licence of its own, its mesh has that of its scene."""
    scene = dataset.scene(donor.scene_id)
    rows = [row for row in scene.object_rows() if row["object_id"] == donor.object_id]
    _check_content(dataset.path, donor.digest, rows)
    thing = read_scene_object(scene, rows[0], bounds)
    return replace(thing, mesh_licence=thing.mesh_licence or scene.row["licence"] or "unknown", contained_in=None)
