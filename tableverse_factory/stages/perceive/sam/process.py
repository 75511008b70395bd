"""The process that holds SAM for all workers of a GPU: `python -m tableverse_factory.stages.perceive.sam.process`."""

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from schemas.geometry import IdImage
from tableverse_factory.models.local.batch_server import Answer, Arrays, Heartbeat
from tableverse_factory.models.local.device import Device
from tableverse_factory.models.local.model_daemon import Spec, ask, main
from tableverse_factory.models.local.weights import absolute
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion, as_ids
from tableverse_factory.stages.perceive.sam.model import load


def ids_from_process(name: str, weights: str, device: Device, batch: int, question: BoxQuestion) -> IdImage:
    """The id image of a picture, computed together with those that others ask for at the same time.

    Raises:
        ModelAccessError: where a person must see to the weights or the machine.
        ModelError: where the memory is not enough for one picture, or the process dies.
    """
    spec: Spec = {
        "name": name,
        "weights": absolute(weights),
        "device": device.kind,
        "precision": device.precision,
        "batch": batch,
    }
    (ids,) = ask(__name__, spec, (question.color, question.boxes, question.holders))
    return as_ids(ids)


def make(spec: Spec) -> tuple[int, Callable[[Heartbeat], Answer]]:
    """The size of a batch, and what makes the model that a spec names."""
    device = Device("cuda" if spec["device"] == "cuda" else "cpu", _precision(str(spec["precision"])))
    batch = int(spec["batch"])

    def made(_: Heartbeat) -> Answer:
        model = load(str(spec["name"]), str(spec["weights"]), device)

        def answer(questions: Sequence[Arrays]) -> Sequence[Arrays]:
            asked = [BoxQuestion(color, boxes, holders) for color, boxes, holders in questions]
            return [(ids.astype(np.int16),) for ids in model.ids(asked, batch)]

        return answer

    return batch, made


def _precision(name: str) -> Literal["float32", "bfloat16"]:
    return "bfloat16" if name == "bfloat16" else "float32"


if __name__ == "__main__":
    main(make)
