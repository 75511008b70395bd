"""Inputs of the detector and the segmenter that run.json records: the prompt and weights."""

from collections.abc import Mapping
from typing import Any

from schemas.config import Config
from tableverse_factory.models.local.recorded_weights import record_onnx, record_weights
from tableverse_factory.stages.perceive.vlm.prompt import choose_box_order, hash_detection_prompt


def record_detector(config: Config, before: Mapping[str, Any]) -> dict[str, Any] | None:
    """Record the prompt of a detector that asks a model, or the weights of one that has any."""
    if config.perceive.protocol:
        return {"prompt_sha256": hash_detection_prompt(choose_box_order(config.perceive))}
    if config.perceive.detector == "grounding_dino":
        return record_weights("detector", "grounding_dino", config, before)
    if config.perceive.detector_weights:
        return record_onnx("perceive.detector_weights", config.perceive.detector_weights)
    return None


def record_segmenter(config: Config, before: Mapping[str, Any]) -> dict[str, Any] | None:
    """Record the weights of a segmenter that has any (see `record_weights`)."""
    backend, weights = config.perceive.segmenter, config.perceive.segmenter_weights
    if backend == "picture":
        return record_onnx("perceive.segmenter_weights", weights) if weights else None
    return None if backend == "geometric" else record_weights("segmenter", backend, config, before)
