"""Protocols of detectors and box segmenters, and their answers."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from schemas.config import Config, PerceiveConfig
from schemas.detection import DetectionRecord
from schemas.geometry import Frozen, IdImage
from schemas.outcome import Dropped
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.table_view import TableView

PixelBox = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax [px]."""

TABLE_ID = -1
"""Value of table-top pixels in an image of ids."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One object named by a detector.

    Attributes:
        instance: Its value in the image of ids; 0 where it has no pixels there.
        container: Index of the candidate that contains it; None for none.
        count: Number of such objects; the box is that of one.
    """

    label: str
    score: float
    box: PixelBox
    instance: int = 0
    container: int | None = None
    count: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class DetectionResult(Frozen):
    """A detector's whole answer.

    Attributes:
        candidates: Every object once, containers before their contents, without the table.
        table_box: Box of the table-top [px]; None where the detector gives none.
        record: Origin of a model's answer; None where no model was asked.
        ids: The instance at each pixel, shape (h, w); None where the detector gives boxes only, for a BoxSegmenter.
    """

    candidates: tuple[Candidate, ...]
    table_box: PixelBox | None = None
    record: DetectionRecord | None = None
    ids: IdImage | None = None


class Detector(Protocol):
    """Finds the objects on the table."""

    def __call__(
        self, view: TableView, config: PerceiveConfig, rng: np.random.Generator, services: Services
    ) -> DetectionResult | Dropped:
        """Detect the objects, or tell why the picture is unusable."""
        ...


@dataclass(frozen=True, slots=True)
class BoxPrompts:
    """Boxes to be segmented.

    Attributes:
        objects: Box of each object.
        holders: Index of the object that contains each object, or None.
        table: Box of the table-top, where the detector gives one.
    """

    objects: tuple[PixelBox, ...]
    holders: tuple[int | None, ...]
    table: PixelBox | None = None


class BoxSegmenter(Protocol):
    """Turns boxes into masks."""

    def __call__(
        self, view: TableView, boxes: BoxPrompts, config: Config, rng: np.random.Generator, services: Services
    ) -> IdImage:
        """Return an image of `k + 1` for the k-th object, `TABLE_ID` for the table-top, else 0; shape (h, w).

        An object has no pixels where nothing in its box stands on the table.
        """
        ...
