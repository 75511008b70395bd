"""Identity of model weights as run.json records it: bytes on the disk, or a commit on the Hugging Face Hub."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from schemas.config import Config
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.fingerprint import DISTRIBUTED_BY, identify_model, identify_onnx_model
from tableverse_factory.models.local.hf_weights import pin_commit, resolve_hub_name

# Section and key of the configuration that name weights of the Hub, by the part of run.json that records them.
_KEYS = {
    "depth": ("observe", "depth_weights"),
    "detector": ("perceive", "detector_weights"),
    "segmenter": ("perceive", "segmenter_weights"),
}


def record_weights(part: str, backend: str, config: Config, before: Mapping[str, Any]) -> dict[str, Any]:
    """Identify the weights of a backend for the `part` of run.json: its published ones if none are named.

    Weights of the Hub stay at the commit that the build began with: `before` is its run.json, or empty.

    Raises:
        ConfigError: if weights on the disk are missing.
        WeightsError: if the commit of weights of the Hub cannot be looked up.
    """
    section, name = _KEYS[part]
    named = getattr(getattr(config, section), name)
    key, weights = f"{section}.{name}", named or DEFAULT_WEIGHTS[backend]
    hub, found = resolve_hub_name(weights, key), identify_model(weights, config.models, DISTRIBUTED_BY.get(backend))
    if hub is None:
        return _require_weights(key, weights, found, "no folder or file here, and no `owner/name` of the hub")
    earlier = before.get(part, {}).get("weights", "")
    unchanged = earlier.startswith(f"{hub.name}@") and before["config"][section].get(name) == named
    return {**found, "weights": earlier if unchanged else pin_commit(weights, key)}


def record_onnx(key: str, weights: str) -> dict[str, Any]:
    """Identify an .onnx file; ConfigError if it is missing."""
    return _require_weights(key, weights, identify_onnx_model(weights), "give the .onnx file")


def pin_commits(config: Config, recorded: Mapping[str, Any]) -> Config:
    """Pin weights of the Hub in a configuration to the commits in run.json."""
    for part, (section, key) in _KEYS.items():
        if weights := recorded.get(part, {}).get("weights"):
            own = getattr(config, section).model_copy(update={key: weights})
            config = config.model_copy(update={section: own})
    return config


def _require_weights(key: str, weights: str, found: dict[str, Any], wanted: str) -> dict[str, Any]:
    """Return what was found of weights on the disk; they must be there before the build begins."""
    if "sha256" in found:
        return found
    lack = "holds no weights" if Path(weights).exists() else f"is not there: {wanted}"
    raise ConfigError(f"{key}: {weights!r} {lack}")
