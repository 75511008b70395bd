"""Inputs of the depth estimation that run.json records: weights."""

from collections.abc import Mapping
from typing import Any

from schemas.config import Config
from tableverse_factory.models.local.recorded_weights import record_weights


def record_depth(config: Config, before: Mapping[str, Any]) -> dict[str, Any] | None:
    """Record the weights of a depth model (see `record_weights`)."""
    backend = config.observe.depth
    return None if backend in ("sensor", "recorded") else record_weights("depth", backend, config, before)
