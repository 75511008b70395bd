"""The `sam2` and `sam3` box segmenters: on a CPU in this process, on a GPU in one that all workers share."""

import numpy as np

from schemas.config import Config
from schemas.geometry import IdImage
from tableverse_factory.models.local.device import device_of
from tableverse_factory.models.local.weights import loaded
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import BoxPrompts, BoxSegmenter
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion
from tableverse_factory.stages.perceive.sam.model import load
from tableverse_factory.stages.perceive.sam.process import ids_from_process


def sam(name: str) -> BoxSegmenter:
    """The box segmenter of this name."""

    def segmenter(
        view: TableView,
        boxes: BoxPrompts,
        config: Config,
        rng: np.random.Generator,  # noqa: ARG001
        services: Services,  # noqa: ARG001
    ) -> IdImage:
        """Masks by the model, which sees colour alone.

        Raises:
            ModelAccessError: where a person must see to the weights or the machine.
            ModelError: where the memory is not enough for one picture.
        """
        return ids_by(name, question_of(view, boxes), config)

    return segmenter


def question_of(view: TableView, boxes: BoxPrompts) -> BoxQuestion:
    """The picture with its boxes, the table's last."""
    table = () if boxes.table is None else (boxes.table,)
    holders = np.array([-1 if holder is None else holder for holder in boxes.holders], dtype=np.int64)
    return BoxQuestion(view.observation.color, np.array([*boxes.objects, *table], dtype=np.float64), holders)


def ids_by(name: str, question: BoxQuestion, config: Config) -> IdImage:
    """The id image of a picture by the model that the configuration names."""
    device, weights = device_of(config.models), config.perceive.segmenter_weights
    if device.kind == "cuda":
        return ids_from_process(name, weights, device, config.perceive.segmenter_batch, question)
    return loaded((name, weights, device), lambda: load(name, weights, device)).ids([question], 1)[0]
