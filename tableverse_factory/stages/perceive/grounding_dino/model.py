"""Grounding DINO (Liu et al. 2023) from transformers: boxes of the things that a text names."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Picture
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.models.local.batches import run_in_batches
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.device import Device, Tensor, import_torch
from tableverse_factory.models.local.pixels import IMAGENET, compute_pixel_values, upload_image
from tableverse_factory.models.local.weights import load_pretrained, load_tokenizer

NAME = "grounding_dino"
KEY = "perceive.detector_weights"
SHORT_SIDE_PX, LONG_SIDE_PX = 800, 1333  # to which the model's own processor scales
SEPARATOR = "."
TOKENS = {"[CLS]": 101, "[SEP]": 102, SEPARATOR: 1012}  # by which the model tells labels apart


@dataclass(frozen=True, slots=True, eq=False)
class LabelScores(Frozen):
    """Boxes of the model's queries, corners as shares of width and height, and each label's score for each."""

    boxes: Float64[np.ndarray, "n 4"]
    scores: Float64[np.ndarray, "n labels"]


@dataclass(frozen=True, slots=True)
class Prompt:
    """Labels as the tokens of one text, and the index of each token's label; -1 between labels."""

    tokens: tuple[int, ...]
    owners: tuple[int, ...]


class GroundingDino:
    """The detector on a device, in float32: coordinates in bfloat16 would be off by several pixels."""

    def __init__(self, model: Any, tokenizer: Any, device: Device) -> None:
        self._model, self._tokenizer, self._device = model, tokenizer, device

    def score_labels(self, color: Picture, labels: Sequence[str]) -> list[LabelScores]:
        """Score the labels for each box, as many at a time as the model takes; the scores of other parts are 0."""
        prompts = self._make_prompts(labels)

        def run(part: Sequence[Prompt], _: int) -> list[LabelScores]:
            return [self._forward(color, prompt, len(labels)) for prompt in part]

        return run_in_batches(run, prompts, 1)[0]

    def _forward(self, color: Picture, prompt: Prompt, count: int) -> LabelScores:
        torch = import_torch()
        on = self._device.torch_device
        with torch.inference_mode():
            size = compute_input_size(color.shape[0], color.shape[1])
            pixels = compute_pixel_values([upload_image(color, self._device)], size, IMAGENET, self._device)
            tokens = torch.tensor([prompt.tokens], device=on)
            answer = self._model(
                pixel_values=pixels,
                pixel_mask=torch.ones((1, *size), dtype=torch.int64, device=on),
                input_ids=tokens,
                token_type_ids=torch.zeros_like(tokens),
                attention_mask=torch.ones_like(tokens),
            )
            per_token = answer.logits[0, :, : len(prompt.tokens)].sigmoid()
            return LabelScores(_to_corners(answer.pred_boxes[0]), group_tokens(per_token, prompt, count))

    def _make_prompts(self, labels: Sequence[str]) -> list[Prompt]:
        """Split the labels into texts such as `cup . wine glass .`, each as long as the model takes.

        The model lets no token see those of another label, so a label's score hardly depends on its neighbours.
        """
        most = int(self._model.config.max_text_len) - 2
        encoded = self._tokenizer([f"{label} {SEPARATOR}" for label in labels], add_special_tokens=False)["input_ids"]
        prompts: list[Prompt] = []
        start = 0
        while start < len(labels):
            tokens, owners, stop = [TOKENS["[CLS]"]], [-1], start
            while stop < len(labels) and len(tokens) + len(encoded[stop]) <= most + 1:
                tokens += encoded[stop]
                owners += [stop] * (len(encoded[stop]) - 1) + [-1]
                stop += 1
            if stop == start:
                raise ConfigError(f"perceive.vocabulary: {labels[start]!r} has more than the {most} tokens of {NAME}")
            prompts.append(Prompt((*tokens, TOKENS["[SEP]"]), (*owners, -1)))
            start = stop
        return prompts


def compute_input_size(height: int, width: int) -> tuple[int, int]:
    """Compute rows and columns of the input: the shorter side 800, the longer at most 1333, as its processor does."""
    short, long = min(height, width), max(height, width)
    exact = min(float(SHORT_SIDE_PX), LONG_SIDE_PX * short / long)
    side = round(exact)
    other = long if side == short else int(exact * long / short)
    return (side, other) if height <= width else (other, side)


def load_grounding_dino(weights: str, device: Device) -> GroundingDino:
    """Load the model and its tokenizer, the default weights if none are named."""
    source, exact = weights or DEFAULT_WEIGHTS[NAME], Device(device.kind, "float32")
    model = load_pretrained("GroundingDinoForObjectDetection", source, exact, KEY, ("grounding-dino",))
    return GroundingDino(model, load_tokenizer(source, KEY, TOKENS), exact)


def group_tokens(per_token: Tensor, prompt: Prompt, count: int) -> Float64[np.ndarray, "n labels"]:
    """Take the highest score of a label's tokens, as the model's own score of a box is the highest of all tokens."""
    values = per_token.cpu().numpy().astype(np.float64)
    scores = np.zeros((len(values), count))
    for token, owner in enumerate(prompt.owners):
        if owner >= 0:
            scores[:, owner] = np.maximum(scores[:, owner], values[:, token])
    return scores


def _to_corners(boxes: Tensor) -> Float64[np.ndarray, "n 4"]:
    """Convert centre, width and height to corners."""
    center, size = np.split(boxes.cpu().numpy().astype(np.float64), 2, axis=1)
    return np.hstack([center - size / 2, center + size / 2])
