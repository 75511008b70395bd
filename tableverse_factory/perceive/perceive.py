"""The second stage: an observation becomes a table and the objects on it."""

from dataclasses import replace

import numpy as np

from schemas.config import Config, PerceiveConfig
from schemas.geometry import Colors, IdImage, Mask, Points
from schemas.identity import object_id
from schemas.objects import PerceivedObject, PerceivedObjects
from schemas.observation import Observation
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.errors import ModelError
from tableverse_factory.perceive.backends import BOX_SEGMENTERS, DETECTORS
from tableverse_factory.perceive.denoise import clean_points
from tableverse_factory.perceive.doors import Boxes, Candidate, Found
from tableverse_factory.perceive.table import camera_to_table, find_table, on_table_top, over_table_box, table_rectangle
from tableverse_factory.perceive.view import TableView
from tableverse_factory.services import Services

MIN_POINTS = 100
MAX_POINTS = 12_000


def perceive(
    item: Observation,
    config: Config,
    rng: np.random.Generator,
    services: Services,
) -> Outcome[PerceivedObjects]:
    """Finds the table, then the things on it; their points are denoised, in the camera frame."""
    view = find_table(item, rng)
    if isinstance(view, Dropped):
        return view
    name = detector_name(item, config.perceive)
    found = DETECTORS[name](view, config.perceive, rng, services)
    if isinstance(found, Dropped):
        return found
    if found.table_box is not None:
        view = over_table_box(view, found.table_box, rng)
    candidates, table_top = with_masks(view, found, config, rng, services)
    if table_top is not None:
        view = on_table_top(view, table_top, rng)
    objects, left_out = _objects(view, candidates, config.perceive)
    if not objects:
        return Dropped(
            "no_objects",
            f"{len(candidates)} candidates by {name!r}, {int(view.raised.sum())} pixels above the table, "
            f"but none with {MIN_POINTS} clean points",
        )
    points = np.vstack([o.points_camera for o in objects])
    pose = camera_to_table(view, points)
    table = table_rectangle(view, pose, points, item.color)
    ids = _id_image(view, candidates, objects)
    return Done(PerceivedObjects(item.scene_id, item, pose, table, ids, objects, name, left_out, found.record))


def detector_name(item: Observation, config: PerceiveConfig) -> str:
    """The backend that `perceive.detector` means for this capture."""
    if config.detector != "auto":
        return config.detector
    return "geometric" if item.recorded_detections is None else "replay"


def with_masks(
    view: TableView, found: Found, config: Config, rng: np.random.Generator, services: Services
) -> tuple[tuple[Candidate, ...], Mask | None]:
    """The candidates, the masks of those that are boxes only filled in by the BoxSegmenter; and that of the table-top.

    Raises:
        ModelError: if the segmenter cannot be asked.
    """
    bare = [k for k, c in enumerate(found.candidates) if c.mask is None]
    if not bare:
        return found.candidates, None
    asked = [found.candidates[k] for k in bare]
    holders = tuple(bare.index(c.container) if c.container in bare else None for c in asked)
    boxes = Boxes(tuple(c.box for c in asked), holders, found.table_box)
    masks = BOX_SEGMENTERS[config.perceive.segmenter](view, boxes, config, rng, services)
    filled = list(found.candidates)
    for k, mask in zip(bare, masks.objects, strict=True):
        filled[k] = replace(filled[k], mask=mask)
    return tuple(filled), masks.table


def _objects(
    view: TableView, candidates: tuple[Candidate, ...], config: PerceiveConfig
) -> tuple[tuple[PerceivedObject, ...], tuple[tuple[str, str], ...]]:
    """Candidates with enough clean points, in the detector's order, and why the others are left out.

    Object ids count the candidates from 0, instance ids from 1, whoever is left out.
    """
    kept: dict[int, PerceivedObject] = {}
    left_out: list[tuple[str, str]] = []
    for index, candidate in enumerate(candidates):
        name = object_id(index)
        if len(kept) == config.max_objects:
            left_out.append((name, f"there are {config.max_objects} objects already (perceive.max_objects)"))
            continue
        points, colors = _points_of(view, candidate)
        if len(points) < MIN_POINTS:
            left_out.append((name, f"{candidate.label}: {len(points)} clean points; at least {MIN_POINTS} are needed"))
            continue
        kept[index] = PerceivedObject(
            name, index + 1, candidate.label, candidate.score, points, colors, count=candidate.count
        )
    objects = tuple(
        replace(item, contained_in=kept[holder].object_id)
        if (holder := candidates[index].container) is not None and holder in kept
        else item
        for index, item in kept.items()
    )
    return objects, tuple(left_out)


def _points_of(view: TableView, candidate: Candidate) -> tuple[Points, Colors]:
    """Clean points with their colours, from measured pixels only, thinned to at most about `MAX_POINTS`."""
    if candidate.mask is None:
        raise ModelError(f"the box of {candidate.label!r} was given no mask")
    rows, columns = np.nonzero(candidate.mask & (view.observation.depth > 0))
    step = max(1, -(-len(rows) // MAX_POINTS))
    rows, columns = rows[::step], columns[::step]
    points = view.points_camera[rows, columns]
    clean = clean_points(points)
    return points[clean], view.observation.color[rows, columns][clean]


def _id_image(view: TableView, candidates: tuple[Candidate, ...], objects: tuple[PerceivedObject, ...]) -> IdImage:
    ids = np.where(view.on_plane, -1, 0).astype(np.int32)
    for item in objects:
        mask = candidates[item.instance_id - 1].mask
        if mask is not None:
            ids[mask] = item.instance_id
    return ids
