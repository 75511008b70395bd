"""The doors behind which things are found: who detects, who turns a box into a mask, and what they answer."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from schemas.config import Config, PerceiveConfig
from schemas.detection import DetectionRecord
from schemas.geometry import Frozen, Mask
from schemas.outcome import Dropped
from tableverse_factory.perceive.view import TableView
from tableverse_factory.services import Services

PixelBox = tuple[float, float, float, float]
"""xmin, ymin, xmax, ymax in pixels of the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate(Frozen):
    """One thing that a detector names.

    Attributes:
        box: Where it is, in pixels.
        mask: Its pixels, shape (h, w); None where the detector gives boxes only and a BoxSegmenter goes on.
        container: Index of the candidate that holds it, among the same answer; or None.
        count: How many of it there are; the box is that of one.
    """

    label: str
    score: float
    box: PixelBox
    mask: Mask | None = None
    container: int | None = None
    count: int = 1


@dataclass(frozen=True, slots=True)
class Found:
    """A detector's whole answer.

    Attributes:
        candidates: Every object once; containers before their contents; never the table itself.
        table_box: Where the detector sees the table-top, in pixels; None where it does not say.
        record: How the answer of a model came about; None where none was asked.
    """

    candidates: tuple[Candidate, ...]
    table_box: PixelBox | None = None
    record: DetectionRecord | None = None


class Detector(Protocol):
    """Finds the things on the table."""

    def __call__(
        self, view: TableView, config: PerceiveConfig, rng: np.random.Generator, services: Services
    ) -> Found | Dropped:
        """What it finds, or why the picture is of no use."""
        ...


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes whose masks are wanted.

    Attributes:
        objects: Of the objects.
        holders: For each object the index of the one that holds it, or None.
        table: Of the table-top; None where the detector does not say.
    """

    objects: tuple[PixelBox, ...]
    holders: tuple[int | None, ...]
    table: PixelBox | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Masks(Frozen):
    """What a box segmenter makes of boxes.

    Attributes:
        objects: A mask per object, shape (h, w) each; empty where nothing in the box stands on the table.
        table: What is seen of the table-top; None where the segmenter cannot tell.
    """

    objects: tuple[Mask, ...]
    table: Mask | None = None


class BoxSegmenter(Protocol):
    """Turns boxes into masks."""

    def __call__(
        self, view: TableView, boxes: Boxes, config: Config, rng: np.random.Generator, services: Services
    ) -> Masks:
        """A mask for each box."""
        ...
