"""The doors behind which things are found: who detects, who turns a box into a mask, and what they answer."""

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
"""xmin, ymin, xmax, ymax in pixels of the picture."""

TABLE_ID = -1
"""Of the table-top in a picture of ids."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One thing that a detector names.

    Attributes:
        box: Where it is, in pixels.
        instance: Its id in the picture of ids; 0 where it has no pixels there.
        container: Index of the candidate that holds it, among the same answer; or None.
        count: How many of it there are; the box is that of one.
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
        candidates: Every object once; containers before their contents; never the table itself.
        table_box: Where the detector sees the table-top, in pixels; None where it does not say.
        record: How the answer of a model came about; None where none was asked.
        ids: The instance at each pixel, shape (h, w); None where the detector gives boxes only, and a BoxSegmenter
            goes on. A mask for each candidate would take a picture's pixels once for each of them.
    """

    candidates: tuple[Candidate, ...]
    table_box: PixelBox | None = None
    record: DetectionRecord | None = None
    ids: IdImage | None = None


class Detector(Protocol):
    """Finds the things on the table."""

    def __call__(
        self, view: TableView, config: PerceiveConfig, rng: np.random.Generator, services: Services
    ) -> DetectionResult | Dropped:
        """What it finds, or why the picture is of no use."""
        ...


@dataclass(frozen=True, slots=True)
class BoxPrompts:
    """Boxes whose masks are wanted.

    Attributes:
        objects: Of the objects.
        holders: For each object the index of the one that holds it, or None.
        table: Of the table-top; None where the detector does not say.
    """

    objects: tuple[PixelBox, ...]
    holders: tuple[int | None, ...]
    table: PixelBox | None = None


class BoxSegmenter(Protocol):
    """Turns boxes into masks."""

    def __call__(
        self, view: TableView, boxes: BoxPrompts, config: Config, rng: np.random.Generator, services: Services
    ) -> IdImage:
        """At each pixel `k + 1` of the k-th object, `TABLE_ID` where the table-top is seen, else 0; shape (h, w).

        An object has no pixels where nothing in its box stands on the table.
        """
        ...
