"""Daemon that holds SAM for all workers of a GPU: `python -m tableverse_factory.stages.perceive.sam.process`."""

from collections.abc import Callable, Sequence

import numpy as np

from schemas.geometry import IdImage
from tableverse_factory.models.local.batch_server import Arrays, BatchModel, Heartbeat
from tableverse_factory.models.local.device import Device
from tableverse_factory.models.local.model_daemon import Spec, ask_daemon, run_daemon
from tableverse_factory.models.local.weights import make_absolute
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion
from tableverse_factory.stages.perceive.sam.model import load_sam


def segment_in_daemon(name: str, weights: str, device: Device, batch: int, question: BoxQuestion) -> IdImage:
    """Segment a picture in the daemon, in one batch with those of other workers."""
    spec: Spec = {
        "name": name,
        "weights": make_absolute(weights),
        "device": device.kind,
        "precision": device.precision,
        "batch": batch,
    }
    (ids,) = ask_daemon(__name__, spec, (question.color, question.boxes, question.holders))
    return ids.astype(np.int32)


def configure_sam_daemon(spec: Spec) -> tuple[int, Callable[[Heartbeat], BatchModel]]:
    """Return the batch size, and a function that makes the model of a description."""
    kind, precision = spec["device"], spec["precision"]
    device = Device("cuda" if kind == "cuda" else "cpu", "bfloat16" if precision == "bfloat16" else "float32")
    batch = int(spec["batch"])

    def make(_: Heartbeat) -> BatchModel:
        model = load_sam(str(spec["name"]), str(spec["weights"]), device)

        def answer(questions: Sequence[Arrays]) -> Sequence[Arrays]:
            decoded = [BoxQuestion(color, boxes, holders) for color, boxes, holders in questions]
            return [(ids.astype(np.int16),) for ids in model.segment(decoded, batch)]

        return answer

    return batch, make


if __name__ == "__main__":
    run_daemon(configure_sam_daemon)
