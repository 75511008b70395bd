"""Proportions of the shapes that bare pictures give, against those that the sensor's depth gives."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.config import Config
from schemas.geometry import IdImage
from schemas.objects import PerceivedObjects, PlacedObject
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.place import place

LEAST_SHARED = 0.6  # IoU of two masks from which they show the same thing


@dataclass(frozen=True, slots=True)
class ProportionError:
    """Height over mean width of a thing from a bare picture, against that from the sensor."""

    found: str  # its object of the bare picture
    sensed: str  # its object of the sensor
    completion: str  # of the bare picture's
    log_ratio: float  # logarithm of the ratio of both proportions; below 0 the bare picture's is too flat

    @property
    def share(self) -> float:
        """Relative error of the proportion, the same for twice too high and twice too flat."""
        return float(np.expm1(abs(self.log_ratio)))


def compare_proportions(
    found: PerceivedObjects, found_ids: IdImage, sensed: PerceivedObjects, config: Config
) -> tuple[ProportionError, ...]:
    """Place the objects of a bare picture and those of the sensor; compare those whose masks show the same thing.

    `found_ids` are the instance ids of the bare picture at the size of the sensor's. Proportions know no scale, so
    its error does not count. A scene that `place` drops has none to compare.
    """
    true = _place(sensed, config)
    errors = []
    for value, item in _place(found, config).items():
        mask = found_ids == value
        shared = {other: _measure_iou(mask, sensed.instance_ids == other) for other in true}
        best = max(shared, key=lambda other: shared[other], default=None)
        if best is not None and shared[best] >= LEAST_SHARED:
            like = true[best]
            ratio = float(np.log(_measure_proportion(item) / _measure_proportion(like)))
            errors.append(ProportionError(item.object_id, like.object_id, item.completion, ratio))
    return tuple(errors)


def _place(perceived: PerceivedObjects, config: Config) -> dict[int, PlacedObject]:
    """Place the objects; give them by their instance ids."""
    outcome = place(perceived, config, make_rng(config.run.seed, "picture", "place"), Services(Path()))
    placed = outcome.value if isinstance(outcome, Done) else None
    if placed is None or placed.evidence is None:
        return {}
    return dict(zip(placed.evidence.object_pixels, placed.objects, strict=True))


def _measure_iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def _measure_proportion(item: PlacedObject) -> float:
    sides = np.ptp(place_mesh(item.mesh, item.pose, item.scale).vertices, axis=0)
    return float(sides[2] / sides[:2].mean())
