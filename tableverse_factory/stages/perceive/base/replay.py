"""The detector `replay`: detections recorded beside the capture."""

import numpy as np
from scipy import ndimage

from schemas.config import Config
from schemas.detection import Box, Detections
from schemas.geometry import IdImage
from schemas.outcome import Dropped
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.box_overlap import compute_iou
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult, PixelBox
from tableverse_factory.stages.perceive.base.table_view import TableView

TABLE_LABELS = ("table", "desk", "countertop", "work surface")


def replay_detections(view: TableView, _config: Config, _services: Services) -> DetectionResult | Dropped:
    """Return the recorded detections; with `masks.png` their masks, else boxes only."""
    recorded, ids = view.observation.recorded_detections, view.observation.recorded_ids
    if recorded is None:
        return Dropped("no_recorded_detections", "perceive.detector is 'replay', but there is no detections.json")
    return to_detection_result(recorded, ids, view.valid.shape)


def to_detection_result(recorded: Detections, ids: IdImage | None, shape: tuple[int, ...]) -> DetectionResult:
    """Convert detections to candidates: single objects, then each container followed by its contents."""
    height, width = shape
    windows = enumerate([] if ids is None else ndimage.find_objects(np.maximum(ids, 0)), start=1)
    boxes = {k: (w[1].start, w[0].start, w[1].stop, w[0].stop) for k, w in windows if w is not None}

    def candidate(
        label: str, score: float, box: Box, instance: int | None, container: int | None = None, count: int = 1
    ) -> Candidate:
        pixels = _to_pixels(box, width, height)
        if instance is None:
            overlaps = {k: compute_iou(pixels, other) for k, other in boxes.items()}
            best = max(overlaps, key=overlaps.__getitem__, default=0)
            instance = best if best and overlaps[best] > 0 else 0
        return Candidate(label, score, pixels, max(instance, 0), container, count)

    tables = [d.bbox_xyxy for d in recorded.detections if d.label.lower() in TABLE_LABELS]
    singles = (d for d in recorded.detections if d.label.lower() not in TABLE_LABELS)
    found = [candidate(d.label, d.score, d.bbox_xyxy, d.instance_id) for d in singles]
    for composite in recorded.composites:
        index, holder = len(found), composite.container
        found.append(candidate(holder.label, 1.0, holder.bbox, holder.instance_id))
        found += [candidate(c.label, 1.0, c.bbox, c.instance_id, index, c.count) for c in composite.contents]
    return DetectionResult(tuple(found), _to_pixels(tables[0], width, height) if tables else None, ids=ids)


def _to_pixels(box: Box, width: int, height: int) -> PixelBox:
    x0, x1 = sorted((box[0] * width / 1000, box[2] * width / 1000))
    y0, y1 = sorted((box[1] * height / 1000, box[3] * height / 1000))
    return x0, y0, x1, y1
