"""SAM 2 and the SAM 3 tracker: segment the boxes of several pictures in one forward pass."""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from schemas.geometry import IdImage
from tableverse_factory.models.local.batches import run_in_batches
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.cuda_graph import CudaGraphRunner
from tableverse_factory.models.local.device import Device, Tensor, import_torch
from tableverse_factory.models.local.pixels import HALF, IMAGENET, Normalization, compute_pixel_values, upload_image
from tableverse_factory.models.local.weights import load_pretrained
from tableverse_factory.stages.perceive.sam.masks import BoxQuestion, clip_boxes, compute_id_image

BOXES = 5  # number of boxes of a picture that are decoded at a time; the last batch is padded
# Modules that encode coordinates: in bfloat16 they would be off by up to four pixels
FLOAT32_PARTS = ("prompt_encoder", "shared_image_embedding")
# Class in transformers, accepted values of `model_type`, and normalization of images
FAMILIES: dict[str, tuple[str, tuple[str, ...], Normalization]] = {
    "sam2": ("Sam2Model", ("sam2", "sam2_video"), IMAGENET),
    "sam3": ("Sam3TrackerModel", ("sam3_tracker", "sam3_tracker_video", "sam3_video"), HALF),
}


class Sam:
    """A box segmenter on a device."""

    def __init__(self, model: Any, normal: Normalization, device: Device) -> None:
        self._model, self._normal, self._device = model, normal, device
        self._side = int(model.config.prompt_encoder_config.image_size)
        self._fitting_size, self._size = sys.maxsize, 0
        self._run_encoder = CudaGraphRunner(self._encode_images, device)
        self._run_decoder = CudaGraphRunner(self._decode, device)

    def segment(self, questions: Sequence[BoxQuestion], size: int) -> list[IdImage]:
        """Segment pictures, `size` in one forward pass; the GPU works while the next are prepared."""
        size = min(size, self._fitting_size)
        copies, fitted = run_in_batches(self._forward, questions, size)
        if fitted < size:
            self._fitting_size = fitted
        found: list[IdImage] = []
        for ids, arrived in copies:
            if arrived is not None:
                arrived.synchronize()
            found.append(ids.numpy().astype(np.int32))
        return found

    def _forward(self, questions: Sequence[BoxQuestion], size: int) -> list[tuple[Tensor, Any]]:
        """Segment pictures; returns targets of copies from the device, int16, with the event at their end or None."""
        torch = import_torch()
        if size != self._size:  # graphs of another size hold the memory that this one needs
            self._size = size
            self._run_encoder.reset()
            self._run_decoder.reset()
        with torch.inference_mode():
            pictures = [upload_image(question.color, self._device) for question in questions]
            pixels = compute_pixel_values(pictures, (self._side, self._side), self._normal, self._device)
            filled = torch.cat([pixels, pixels[-1:].expand(size - len(pixels), -1, -1, -1)])
            scores = self.scores(filled, [self._boxes(question) for question in questions])
            found = [compute_id_image(mine[: len(q.boxes)], q) for mine, q in zip(scores, questions, strict=False)]
            if self._device.kind == "cpu":
                return [(ids, None) for ids in found]
            targets = (torch.empty(ids.shape, dtype=ids.dtype, pin_memory=True) for ids in found)
            copies = [target.copy_(ids, non_blocking=True) for target, ids in zip(targets, found, strict=True)]
            arrived = torch.cuda.Event()
            arrived.record()
            return [(ids, arrived) for ids in copies]

    def _boxes(self, question: BoxQuestion) -> np.ndarray:
        """Scale boxes to the model's square input, shape (k, 4)."""
        height, width = question.color.shape[:2]
        scale = self._side / np.array([width, height, width, height], dtype=np.float64)
        return (clip_boxes(question.boxes, height, width) * scale).astype(np.float32)

    def scores(self, pixels: Tensor, boxes: Sequence[np.ndarray]) -> Tensor:
        """Compute a low-resolution score image for each box, in float32; above 0 is inside.

        Pixels have shape (n, 3, side, side), boxes (k, 4) in that square, any k; padding has none. Returns shape
        (n, m, s, s), m a multiple of `BOXES`; undefined beyond a picture's own boxes.
        """
        torch = import_torch()
        rounds = max(1, -(-max(len(own) for own in boxes) // BOXES))
        padded = np.zeros((len(pixels), rounds * BOXES, 4), dtype=np.float32)
        for row, own in zip(padded, boxes, strict=False):
            row[: len(own)] = own
        prompts = torch.from_numpy(padded).to(self._device.torch_device, non_blocking=True)
        features = self._run_encoder(pixels)
        scores = [self._run_decoder(part, *features)[0].clone() for part in prompts.split(BOXES, dim=1)]
        return torch.cat(scores, dim=1)

    def _encode_images(self, pixels: Tensor) -> tuple[Tensor, ...]:
        return tuple(self._model.get_image_embeddings(pixels))  # feature maps, the finest first

    def _decode(self, boxes: Tensor, *features: Tensor) -> tuple[Tensor, ...]:
        """Compute the score images of `BOXES` boxes of each picture, shape (n, `BOXES`, s, s), in float32."""
        model, dtype = self._model, self._device.dtype
        *fine, coarse = features
        sparse, dense = model.get_prompt_embeddings(input_boxes=boxes)
        positions = model.get_image_wide_positional_embeddings().to(dtype).repeat(len(boxes), 1, 1, 1)
        masks, *_ = model.mask_decoder(
            image_embeddings=coarse,
            image_positional_embeddings=positions,
            sparse_prompt_embeddings=sparse.to(dtype),
            dense_prompt_embeddings=dense.to(dtype),
            multimask_output=False,
            high_resolution_features=fine,
        )
        return (masks[:, :, 0].float(),)


def load_sam(name: str, weights: str, device: Device) -> Sam:
    """Load a model, with the default weights if none are named."""
    architecture, kinds, normal = FAMILIES[name]
    key, source = "perceive.segmenter_weights", weights or DEFAULT_WEIGHTS[name]
    return Sam(load_pretrained(architecture, source, device, key, kinds, FLOAT32_PARTS), normal, device)
