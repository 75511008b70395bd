"""Box segmenters `sam2` and `sam3`: in this process on a CPU, in a shared daemon on a GPU."""

import numpy as np

from schemas.config import Config
from schemas.geometry import IdImage
from tableverse_factory.models.local.device import select_device
from tableverse_factory.models.local.weights import load_once
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion
from tableverse_factory.stages.perceive.sam.model import load_sam
from tableverse_factory.stages.perceive.sam.process import segment_in_daemon


def segment_with_sam(name: str, view: TableView, found: DetectionResult, config: Config) -> IdImage:
    """Segment boxes by colour alone with the model of this name."""
    question = build_question(view, found)
    device, weights = select_device(config.models), config.perceive.segmenter_weights
    if device.kind == "cuda":
        return segment_in_daemon(name, weights, device, config.perceive.segmenter_batch, question)
    return load_once((name, weights, device), lambda: load_sam(name, weights, device)).segment([question], 1)[0]


def build_question(view: TableView, found: DetectionResult) -> BoxQuestion:
    """Build the question for a picture and its boxes, the table's last."""
    boxes = [candidate.box for candidate in found.candidates] + ([found.table_box] if found.table_box else [])
    holders = [-1 if candidate.container is None else candidate.container for candidate in found.candidates]
    return BoxQuestion(view.observation.color, np.array(boxes, dtype=np.float64), np.array(holders, dtype=np.int64))
