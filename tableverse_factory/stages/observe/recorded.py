"""Inputs of the depth estimation that run.json records: weights."""

from collections.abc import Mapping
from typing import Any

from schemas.config import Config
from tableverse_factory.models.local.recorded_weights import record_onnx, record_weights


def record_depth(config: Config, before: Mapping[str, Any]) -> dict[str, Any] | None:
    """Record the weights of a depth model (see `record_weights`); the hash of the code covers the shipped ones."""
    backend, weights = config.observe.depth, config.observe.depth_weights
    if backend == "picture":
        return record_onnx("observe.depth_weights", weights) if weights else None
    return None if backend in ("sensor", "recorded") else record_weights("depth", backend, config, before)
