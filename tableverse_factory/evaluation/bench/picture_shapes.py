"""Proportions of shapes from bare pictures, against those of the same things from the sensor's depth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.config import Config
from schemas.geometry import IdImage
from schemas.objects import PerceivedObjects, PlacedObject
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.perception import match_ids
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.place import place

LEAST_SHARED = 0.6  # IoU of two masks from which they show the same thing


@dataclass(frozen=True, slots=True)
class ProportionError:
    """Height over width of an object of a bare picture, against that of the same thing from the sensor.

    The width is the mean of the sides of the least rectangle around the shape, seen from above.
    """

    object_id: str
    sensor_object_id: str
    completion: str  # of the bare picture's shape
    log_ratio: float  # logarithm of the ratio of both proportions; below 0 the bare picture's shape is too flat


@dataclass(frozen=True, slots=True)
class ShapeScore:
    """Proportions in one bare picture."""

    objects: int  # that the sensor gives, of which only some are found in the picture
    proportions: tuple[ProportionError, ...]


def compare_proportions(
    found: PerceivedObjects, found_ids: IdImage, sensed: PerceivedObjects, config: Config
) -> ShapeScore:
    """Place the objects of a bare picture and those of the sensor; compare those whose masks show the same thing.

    `found_ids` are the instance ids of the bare picture at the size of the sensor's. Proportions have no scale, so its
    error does not count. A scene that `place` drops has no objects.
    """
    true, errors = _place_objects(sensed, config), []
    same = match_ids(sensed.instance_ids, found_ids)
    for value, item in _place_objects(found, config).items():
        like = true.get(same.get(value, 0))
        if like is None or _measure_iou(found_ids == value, sensed.instance_ids == same[value]) < LEAST_SHARED:
            continue
        ratio = float(np.log(_measure_proportion(item) / _measure_proportion(like)))
        errors.append(ProportionError(item.object_id, like.object_id, item.completion, ratio))
    return ShapeScore(len(true), tuple(errors))


def _place_objects(perceived: PerceivedObjects, config: Config) -> dict[int, PlacedObject]:
    """Place the objects; give them by their instance ids."""
    outcome = place(perceived, config, make_rng(config.run.seed, "picture", "place"), Services(Path()))
    placed = outcome.value if isinstance(outcome, Done) else None
    if placed is None or placed.evidence is None:
        return {}
    return dict(zip(placed.evidence.object_pixels, placed.objects, strict=True))


def _measure_iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def _measure_proportion(item: PlacedObject) -> float:
    vertices = place_mesh(item.mesh, item.pose, item.scale).vertices
    width = 2.0 * float(fit_min_rectangle(vertices[:, :2]).half_size.mean())
    return float(np.ptp(vertices[:, 2])) / width
