"""Policies with weights in the package, by name."""

from collections.abc import Mapping
from pathlib import Path

SHIPPED: Mapping[str, Path] = {name: Path(__file__).with_name(f"{name}.safetensors") for name in ("picture", "state")}
