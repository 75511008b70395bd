"""The detector `grounding_dino`: a local open-vocabulary model names and boxes the objects in the picture."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.config import Config, PerceiveConfig
from tableverse_factory.models.local.device import select_device
from tableverse_factory.models.local.weights import load_once
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.box_overlap import compute_iou
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult
from tableverse_factory.stages.perceive.base.replay import TABLE_LABELS
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.grounding_dino.model import NAME, LabelScores, load_grounding_dino

TABLE = "table"
PEOPLE = ("person", "hand", "arm")  # asked for so that they are not taken for objects, and left out
MIN_SIDE_PX = 3.0
MAX_BOXES = 400  # the best ones that are compared with one another


def detect_with_grounding_dino(view: TableView, config: Config, _services: Services) -> DetectionResult:
    """Detect the things of the vocabulary and the table, the surest first; contents are not told from containers."""
    device, weights = select_device(config.models), config.perceive.detector_weights
    model = load_once((NAME, weights, device), lambda: load_grounding_dino(weights, device))
    labels = list_labels(config.perceive.vocabulary)
    color = view.observation.color
    found = select_boxes(model.score_labels(color, labels), labels, color.shape[:2], config.perceive)
    table = next((candidate.box for candidate in found if candidate.label in TABLE_LABELS), None)
    ignored = (*TABLE_LABELS, *PEOPLE)
    return DetectionResult(tuple(candidate for candidate in found if candidate.label not in ignored), table)


def list_labels(vocabulary: Sequence[str]) -> list[str]:
    """List what the model is asked for: the table, people, and the vocabulary, each once."""
    return list(dict.fromkeys((TABLE, *PEOPLE, *vocabulary)))


def select_boxes(
    found: Sequence[LabelScores], labels: Sequence[str], shape: tuple[int, ...], config: PerceiveConfig
) -> list[Candidate]:
    """Select boxes with a sure label, the surest first, without those that overlap a surer one too much."""
    candidates = [candidate for part in found for candidate in _name_boxes(part, labels, shape, config.detector_score)]
    candidates.sort(key=lambda candidate: (-candidate.score, candidate.box, candidate.label))
    kept: list[Candidate] = []
    for candidate in candidates[:MAX_BOXES]:
        if all(compute_iou(candidate.box, other.box) <= config.detector_overlap for other in kept):
            kept.append(candidate)
    return kept


def _name_boxes(part: LabelScores, labels: Sequence[str], shape: tuple[int, ...], least: float) -> list[Candidate]:
    """Name each box by the label with the highest score, if that is high enough and the box is one; in pixels."""
    height, width = shape
    best = part.scores.argmax(axis=1)
    score = part.scores[np.arange(len(best)), best]
    boxes: Float64[np.ndarray, "n 4"] = np.clip(part.boxes, 0.0, 1.0) * [width, height, width, height]
    is_box = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] - boxes[:, :2] >= MIN_SIDE_PX).all(axis=1)
    chosen = np.flatnonzero(is_box & (score >= least))
    return [
        Candidate(labels[label], sure, (x0, y0, x1, y1))
        for label, sure, (x0, y0, x1, y1) in zip(
            best[chosen], score[chosen].tolist(), boxes[chosen].tolist(), strict=True
        )
    ]
