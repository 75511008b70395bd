"""The `replay` detector: what somebody recorded beside the capture, as candidates."""

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from schemas.config import PerceiveConfig
from schemas.detection import Box, Detections
from schemas.geometry import IdImage
from schemas.outcome import Dropped
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult, PixelBox
from tableverse_factory.stages.perceive.base.table_view import TableView

TABLE_LABELS = ("table", "desk", "countertop", "work surface")


def replay_detections(
    view: TableView,
    config: PerceiveConfig,  # noqa: ARG001
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,  # noqa: ARG001
) -> DetectionResult | Dropped:
    """The recorded detections; with `masks.png` their masks, else boxes only."""
    recorded, ids = view.observation.recorded_detections, view.observation.recorded_ids
    if recorded is None:
        return Dropped("no_recorded_detections", "perceive.detector is 'replay', but there is no detections.json")
    return to_detection_result(recorded, ids, view.valid.shape)


def to_detection_result(recorded: Detections, ids: IdImage | None, shape: tuple[int, ...]) -> DetectionResult:
    """A detector's answer as candidates: regular objects, then each container followed by its contents."""
    height, width = shape[0], shape[1]
    windows = [] if ids is None else ndimage.find_objects(np.maximum(ids, 0))

    def candidate(
        label: str, score: float, box: Box, instance: int | None, container: int | None = None, count: int = 1
    ) -> Candidate:
        pixels = _to_pixels(box, width, height)
        instance = _find_best_id(windows, pixels) if instance is None else max(instance, 0)
        return Candidate(label, score, pixels, instance, container, count)

    tables = [d.bbox_xyxy for d in recorded.detections if d.label.lower() in TABLE_LABELS]
    found = [
        candidate(d.label, d.score, d.bbox_xyxy, d.instance_id)
        for d in recorded.detections
        if d.label.lower() not in TABLE_LABELS
    ]
    for composite in recorded.composites:
        holder = len(found)
        found.append(
            candidate(composite.container.label, 1.0, composite.container.bbox, composite.container.instance_id)
        )
        found += [candidate(c.label, 1.0, c.bbox, c.instance_id, holder, c.count) for c in composite.contents]
    return DetectionResult(tuple(found), _to_pixels(tables[0], width, height) if tables else None, ids=ids)


def _to_pixels(box: Box, width: int, height: int) -> PixelBox:
    x0, x1 = sorted((box[0] * width / 1000, box[2] * width / 1000))
    y0, y1 = sorted((box[1] * height / 1000, box[3] * height / 1000))
    return x0, y0, x1, y1


def _find_best_id(windows: Sequence[tuple[slice, slice] | None], box: PixelBox) -> int:
    """The id whose own box overlaps the given one most (intersection over union); 0 where none does.

    Args:
        windows: Where each id lies in the picture, from 1; None for those that are not there.
        box: In pixels.
    """
    best, best_overlap = 0, 0.0
    for value, window in enumerate(windows, start=1):
        if window is None:
            continue
        rows, columns = window
        overlap = box_overlap(box, (columns.start, rows.start, columns.stop, rows.stop))
        if overlap > best_overlap:
            best, best_overlap = value, overlap
    return best


def box_overlap(a: PixelBox, b: tuple[float, ...]) -> float:
    """Intersection over union of two boxes."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    shared = width * height
    return float(shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared))
