"""SAM 2 and the tracker of SAM 3: boxes of several pictures become masks in one forward."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.geometry import IdImage
from tableverse_factory.models.local.batches import in_batches
from tableverse_factory.models.local.cuda_graph import CudaGraphRunner
from tableverse_factory.models.local.device import Device, Tensor, torch_here
from tableverse_factory.models.local.hf_weights import PUBLISHED
from tableverse_factory.models.local.pixels import HALF, IMAGENET, Normal, picture_on, pixel_values
from tableverse_factory.models.local.weights import pretrained
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion, as_ids, ids_of, inside

BOXES = 5
"""Boxes of a picture that are decoded at a time; the last are filled up."""
EXACT = ("prompt_encoder", "shared_image_embedding")
"""Where boxes become numbers: a coordinate in bfloat16 would be off by up to four pixels."""


@dataclass(frozen=True, slots=True)
class Family:
    """What differs between the models.

    Attributes:
        architecture: Class in transformers.
        kinds: What their configurations are called.
        normal: Of the pictures that they were trained on.
    """

    architecture: str
    kinds: tuple[str, ...]
    normal: Normal


FAMILIES = {
    "sam2": Family("Sam2Model", ("sam2", "sam2_video"), IMAGENET),
    "sam3": Family("Sam3TrackerModel", ("sam3_tracker", "sam3_tracker_video", "sam3_video"), HALF),
}


@dataclass(frozen=True, slots=True)
class Pending:
    """The id image of a picture on its way from the device.

    Attributes:
        ids: Where it arrives, shape (h, w), int16.
        arrived: Event after which it is there; None where it is already.
    """

    ids: Tensor
    arrived: Any

    def result(self) -> IdImage:
        """Waits for it."""
        if self.arrived is not None:
            self.arrived.synchronize()
        return as_ids(self.ids.numpy())


class Sam:
    """A model of the family, on a device, and how it is asked."""

    def __init__(self, model: Any, normal: Normal, device: Device) -> None:
        """Takes a model that is on the device."""
        self._model, self._normal, self._device = model, normal, device
        self._side = int(model.config.prompt_encoder_config.image_size)
        self._most, self._size = sys.maxsize, 0
        self._seen, self._decoded = CudaGraphRunner(self._see, device), CudaGraphRunner(self._decode, device)

    def ids(self, questions: Sequence[BoxQuestion], size: int) -> list[IdImage]:
        """The id image of each picture (`ids_of`), so many pictures in one forward.

        Raises:
            ModelError: if not even one picture fits into the memory.
        """
        return [pending.result() for pending in self.begin(questions, size)]

    def begin(self, questions: Sequence[BoxQuestion], size: int) -> list[Pending]:
        """The same without waiting: a GPU goes on working while the next pictures are prepared."""
        size = min(size, self._most)
        pending, fitted = in_batches(self._forward, questions, size)
        if fitted < size:
            self._most = fitted
        return pending

    def _forward(self, questions: Sequence[BoxQuestion], size: int) -> list[Pending]:
        torch = torch_here()
        if size != self._size:  # what was recorded for another size keeps the memory that this one needs
            self._size = size
            self._seen.forget()
            self._decoded.forget()
        with torch.inference_mode():
            pictures = [picture_on(question.color, self._device) for question in questions]
            pixels = pixel_values(pictures, (self._side, self._side), self._normal, self._device)
            filled = torch.cat([pixels, pixels[-1:].expand(size - len(pixels), -1, -1, -1)])
            scores = self.scores(filled, [self._boxes(question) for question in questions])
            found = [ids_of(mine[: len(q.boxes)], q) for mine, q in zip(scores, questions, strict=False)]
            if self._device.kind == "cpu":
                return [Pending(ids, None) for ids in found]
            here = [
                torch.empty(ids.shape, dtype=ids.dtype, pin_memory=True).copy_(ids, non_blocking=True) for ids in found
            ]
            arrived = torch.cuda.Event()
            arrived.record()
            return [Pending(ids, arrived) for ids in here]

    def _boxes(self, question: BoxQuestion) -> np.ndarray:
        """The boxes in the model's square, shape (k, 4): it knows no aspect."""
        height, width = question.color.shape[:2]
        scale = self._side / np.array([width, height, width, height], dtype=np.float64)
        scaled: np.ndarray = (inside(question.boxes, height, width) * scale).astype(np.float32)
        return scaled

    def scores(self, pixels: Tensor, boxes: Sequence[np.ndarray]) -> Tensor:
        """A small score image for each box, in float32: above 0 is inside.

        Args:
            pixels: Shape (n, 3, side, side).
            boxes: Of each picture, in the model's square, shape (k, 4) each, any k; none of those that only fill up.

        Returns:
            Shape (n, m, s, s), m a multiple of `BOXES`; beyond a picture's own boxes without meaning.
        """
        torch = torch_here()
        rounds = max(1, -(-max(len(own) for own in boxes) // BOXES))
        padded = np.zeros((len(pixels), rounds * BOXES, 4), dtype=np.float32)
        for row, own in zip(padded, boxes, strict=False):
            row[: len(own)] = own
        prompts = torch.from_numpy(padded).to(self._device.where, non_blocking=True)
        seen = self._seen(pixels)
        found = [self._decoded(part, *seen)[0].clone() for part in prompts.split(BOXES, dim=1)]
        return torch.cat(found, dim=1)

    def _see(self, pixels: Tensor) -> tuple[Tensor, ...]:
        """What the model knows of pictures before it is asked: images of features, the finest first."""
        features: tuple[Tensor, ...] = tuple(self._model.get_image_embeddings(pixels))
        return features

    def _decode(self, boxes: Tensor, *seen: Tensor) -> tuple[Tensor, ...]:
        """Score images of `BOXES` boxes of each picture, shape (n, `BOXES`, s, s), in float32."""
        model, dtype = self._model, self._device.dtype
        *fine, coarse = seen
        sparse, dense = model.get_prompt_embeddings(input_boxes=boxes)
        masks, *_ = model.mask_decoder(
            image_embeddings=coarse,
            image_positional_embeddings=model.get_image_wide_positional_embeddings()
            .to(dtype)
            .repeat(len(boxes), 1, 1, 1),
            sparse_prompt_embeddings=sparse.to(dtype),
            dense_prompt_embeddings=dense.to(dtype),
            multimask_output=False,
            high_resolution_features=fine,
        )
        return (masks[:, :, 0].float(),)


def load(name: str, weights: str, device: Device) -> Sam:
    """The model with its weights; the published ones where none are named.

    Raises:
        ModelAccessError: where a person must see to the weights or the machine.
    """
    family = FAMILIES[name]
    key = "perceive.segmenter_weights"
    model = pretrained(family.architecture, weights or PUBLISHED[name], device, key, family.kinds, EXACT)
    return Sam(model, family.normal, device)
