"""Box segmenters `sam2` and `sam3`: in this process on a CPU, in a shared daemon on a GPU."""

import numpy as np

from schemas.config import Config
from schemas.geometry import IdImage
from tableverse_factory.models.local.device import select_device
from tableverse_factory.models.local.weights import load_once
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import BoxPrompts, BoxSegmenter
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion
from tableverse_factory.stages.perceive.sam.model import load_sam
from tableverse_factory.stages.perceive.sam.process import segment_in_daemon


def make_sam_segmenter(name: str) -> BoxSegmenter:
    """Create the box segmenter of a name."""

    def segmenter(
        view: TableView,
        boxes: BoxPrompts,
        config: Config,
        rng: np.random.Generator,  # noqa: ARG001
        services: Services,  # noqa: ARG001
    ) -> IdImage:
        """Segment boxes by colour alone.

        Raises:
            ModelAccessError: if a person must act on the weights or the machine.
            ModelError: if one picture does not fit into the memory.
        """
        return segment_question(name, build_question(view, boxes), config)

    return segmenter


def build_question(view: TableView, boxes: BoxPrompts) -> BoxQuestion:
    """Build the question for a picture and its boxes, the table's last."""
    table = () if boxes.table is None else (boxes.table,)
    holders = np.array([-1 if holder is None else holder for holder in boxes.holders], dtype=np.int64)
    return BoxQuestion(view.observation.color, np.array([*boxes.objects, *table], dtype=np.float64), holders)


def segment_question(name: str, question: BoxQuestion, config: Config) -> IdImage:
    """Segment a picture with the model that the configuration names."""
    device, weights = select_device(config.models), config.perceive.segmenter_weights
    if device.kind == "cuda":
        return segment_in_daemon(name, weights, device, config.perceive.segmenter_batch, question)
    return load_once((name, weights, device), lambda: load_sam(name, weights, device)).segment([question], 1)[0]
