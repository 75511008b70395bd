"""What a model with weights is, for run.json: another one under the same name would give other bytes."""

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from schemas.identity import content_hash

PACKAGES = ("torch", "transformers")
_READ = ("*.safetensors", "*.json")


def identity(weights: str) -> dict[str, Any]:
    """The versions of what runs the model here, and the bytes of its weights where they are a folder.

    Weights of the hub count by their name alone: what is fetched during a build must not change what it is.
    """
    found: dict[str, Any] = {name: _version(name) for name in PACKAGES}
    folder = Path(weights)
    if weights and folder.is_dir():
        files = sorted(path for pattern in _READ for path in folder.glob(pattern) if path.is_file())
        found["sha256"] = content_hash(*(f"{path.name} {_digest(path)}".encode() for path in files))
    return found


def onnx_identity(weights: str) -> dict[str, Any]:
    """The version of what runs an ONNX file here, and its bytes; none where there is no such file."""
    path = Path(weights)
    found: dict[str, Any] = {"onnxruntime": _version("onnxruntime")}
    return {**found, "sha256": _digest(path)} if path.is_file() else found


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"
