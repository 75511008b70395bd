"""Protocols of detectors and box segmenters, and their answers."""

from dataclasses import dataclass
from typing import Protocol

from schemas.config import Config
from schemas.detection import DetectionRecord
from schemas.geometry import Frozen, IdImage, Mask
from schemas.outcome import Dropped
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.table_view import TableView

PixelBox = tuple[float, float, float, float]  # xmin, ymin, xmax, ymax [px]


@dataclass(frozen=True, slots=True)
class Candidate:
    """One object named by a detector, or `count` alike, of which the box shows one."""

    label: str
    score: float
    box: PixelBox
    instance: int = 0  # its value in the image of ids; 0 where it has no pixels there
    container: int | None = None  # index of the candidate that contains it
    count: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class DetectionResult(Frozen):
    """A detector's whole answer."""

    candidates: tuple[Candidate, ...]  # every object once, containers before their contents, without the table
    table_box: PixelBox | None = None
    table_top: Mask | None = None  # where the table is seen; where the plane found misses it, both are found again
    record: DetectionRecord | None = None  # origin of the answer; None where no model was asked
    ids: IdImage | None = None  # the instance at each pixel; None for boxes only, for a BoxSegmenter
    shown: Mask | None = None  # what objects must explain; None: wherever the depth rises over the table


class Detector(Protocol):
    """Finds the objects on the table."""

    def __call__(self, view: TableView, config: Config, services: Services, /) -> DetectionResult | Dropped:
        """Detect the objects, or tell why the picture is unusable."""
        ...


class BoxSegmenter(Protocol):
    """Turns boxes into masks."""

    def __call__(self, view: TableView, found: DetectionResult, config: Config, /) -> IdImage:
        """Return an image of `k + 1` for the k-th candidate, `TABLE_ID` for the table-top, else 0; shape (h, w).

        A candidate has no pixels where nothing in its box stands on the table.
        """
        ...
