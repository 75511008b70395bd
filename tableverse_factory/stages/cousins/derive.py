"""First stage of cousins: a finished scene of a dataset, changed as the recipe says where there is room."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from schemas.config import Config, ObserveConfig
from schemas.cousins import Change, Recipe, parse_recipe
from schemas.manifest import ImageRow
from schemas.objects import PlacedObject, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.dataset.cousin_rows import digest_inputs
from tableverse_factory.dataset.dataset import Dataset, Scene, open_dataset
from tableverse_factory.models.services import Services
from tableverse_factory.stages.cousins.arrangement import Arrangement
from tableverse_factory.stages.cousins.changes import Draft
from tableverse_factory.stages.cousins.parent import read_parent, read_scene_object
from tableverse_factory.stages.cousins.reflection import mirror_object

_open = lru_cache(2)(open_dataset)  # its index of scenes is read once in a process


def derive_cousin(
    item: ImageRow,
    config: Config,
    rng: np.random.Generator,
    services: Services,  # noqa: ARG001
) -> Outcome[PlacedObjects]:
    """Change a scene of a dataset; the later stages separate, settle, judge and certify it like any other layout.

    Drops: `content_changed` if the dataset is not the one that the manifest saw, `no_room` if nothing could be changed,
    `bad_recipe` if the row has none, and the reason why the parent cannot be read.
    """
    if item.rejected:
        return Dropped(item.rejected, item.rejected_detail)
    try:
        recipe = _read_recipe(item)
        dataset = _open(item.uri)
        _check_content(item, recipe, dataset)
        parent = read_parent(dataset.scene(item.parent), config.observe)
        draft = Draft(Arrangement(parent.objects, parent.table), rng, _list_donors(dataset, recipe, config.observe))
        for change in recipe.changes:
            if change is not Change.MIRROR:
                draft.make(change)
        draft.fill()
    except InputError as error:
        return Dropped(error.reason, str(error))
    except GeometryError as error:
        return Dropped("bad_mesh", str(error))
    objects = tuple(draft.arrangement.objects.values())
    if Change.MIRROR in recipe.changes:
        objects = tuple(mirror_object(thing, parent.table) for thing in objects)
        draft.changes.append(Change.MIRROR.value)
    if not draft.changes:
        return Dropped("no_room", f"on the table of {item.parent} for any of: {', '.join(recipe.changes)}")
    return Done(
        PlacedObjects(item.scene_id, parent.table, objects, perception=parent.perception, changes=tuple(draft.changes))
    )


def _read_recipe(item: ImageRow) -> Recipe:
    if not item.parent:
        raise InputError("a cousin's row names its parent: `tableverse cousins` writes such rows", "bad_recipe")
    try:
        return parse_recipe(item.recipe)
    except ValueError as error:
        raise InputError(f"{error}: `tableverse cousins` writes recipes", "bad_recipe") from error


def _check_content(item: ImageRow, recipe: Recipe, dataset: Dataset) -> None:
    scenes = {item.parent, *(donor.scene_id for donor in recipe.donors)}
    found = digest_inputs(item.parent, recipe, {name: dataset.scene(name).object_rows() for name in sorted(scenes)})
    if item.content_sha256 and found != item.content_sha256:
        change = f"sha256 {found[:12]}, not {item.content_sha256[:12]}"
        raise InputError(
            f"the dataset is not the one that was planned with ({change}): run it again", "content_changed"
        )


def _list_donors(
    dataset: Dataset, recipe: Recipe, bounds: ObserveConfig
) -> dict[str, list[tuple[str, Callable[[], PlacedObject]]]]:
    """List the readers of things that may replace an object, by its id; they are read when they are tried."""
    found: dict[str, list[tuple[str, Callable[[], PlacedObject]]]] = {}
    for donor in recipe.donors:
        read = partial(_read_donor, dataset, donor.scene_id, donor.object_id, bounds)
        found.setdefault(donor.replaces, []).append((f"{donor.scene_id}/{donor.object_id}", read))
    return found


def _read_donor(dataset: Dataset, scene_id: str, object_id: str, bounds: ObserveConfig) -> PlacedObject:
    """Read an object of another scene; without a licence of its own, its mesh has that of its scene."""
    scene: Scene = dataset.scene(scene_id)
    rows = [row for row in scene.object_rows() if row["object_id"] == object_id]
    if not rows:
        raise InputError(f"scene {scene_id} has no object {object_id}", "bad_scene")
    thing = read_scene_object(scene, rows[0], bounds)
    return replace(thing, mesh_licence=thing.mesh_licence or scene.row["licence"] or "unknown", contained_in=None)
