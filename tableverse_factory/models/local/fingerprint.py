"""What a model with weights is, for run.json: another one under the same name would give other bytes."""

import hashlib
import json
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

from schemas.config import ModelsConfig
from schemas.identity import content_hash
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.local.device import device_of

PACKAGES = ("torch", "transformers")
DISTRIBUTED_BY = {
    "depth_anything_3": "depth-anything-3",
    "depth_anything_3_nested": "depth-anything-3",
    "moge_2": "moge",
}
"""The package on git of each depth model that has one."""
_READ = ("*.safetensors", "*.json", "*.pt")


def identity(weights: str, config: ModelsConfig, package: str | None = None) -> dict[str, Any]:
    """The versions of what runs the model here, where it runs, and the bytes of its weights where they are a path.

    Args:
        weights: Folder, file, or name on the hub.
        config: Where models run; what `auto` means is looked up on this machine.
        package: What else runs it, besides `PACKAGES`.
    """
    found: dict[str, Any] = {name: _version(name) for name in PACKAGES}
    if package:
        found[package] = _version(package) + _commit(package)
    if config.device == "auto":
        found["device"] = _automatic()
    files = _files(weights)
    if files:
        found["sha256"] = content_hash(*(f"{path.name} {_digest(path)}".encode() for path in files))
    return found


def stamp(weights: str) -> str:
    """Changes wherever the weights on the disk do, without reading them: for this machine, and for now."""
    stats = ((path.name, path.stat()) for path in _files(weights))
    return " ".join(f"{name} {found.st_ino} {found.st_size} {found.st_mtime_ns}" for name, found in stats)


def _files(weights: str) -> list[Path]:
    path = Path(weights)
    if weights and path.is_dir():
        return sorted(found for pattern in _READ for found in path.glob(pattern) if found.is_file())
    return [path] if weights and path.is_file() else []


def _automatic() -> str:
    """The device that `auto` is here; without torch there is none."""
    try:
        return device_of(ModelsConfig()).kind
    except ModelAccessError:
        return "none"


def _commit(package: str) -> str:
    """The commit that was installed, after a blank; nothing where it came from elsewhere."""
    try:
        said = json.loads(distribution(package).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        return ""
    commit = said.get("vcs_info", {}).get("commit_id", "")
    return f" {commit}" if commit else ""


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
