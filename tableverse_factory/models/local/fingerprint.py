"""Identity of a model with weights for run.json: versions of its packages and a hash of its files."""

import json
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

from schemas.config import ModelsConfig
from schemas.identity import content_hash
from tableverse_factory.core.errors import WeightsError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.models.local.device import select_device

PACKAGES = ("torch", "transformers")
# Distributions that are installed from git, by depth model.
DISTRIBUTED_BY = {
    "depth_anything_3": "depth-anything-3",
    "depth_anything_3_nested": "depth-anything-3",
    "moge_2": "moge",
}
_WEIGHT_FILES = ("*.safetensors", "*.json", "*.pt")


def identify_model(weights: str, config: ModelsConfig, package: str | None = None) -> dict[str, Any]:
    """Collect the versions of `PACKAGES` and `package`, the device that `auto` means, and the hash of weights on disk.

    The device is `none` without torch.
    """
    found: dict[str, Any] = {name: _read_version(name) for name in PACKAGES}
    if package:
        found[package] = _read_version(package) + _read_commit(package)
    if config.device == "auto":
        try:
            found["device"] = select_device(ModelsConfig()).kind
        except WeightsError:
            found["device"] = "none"
    if files := _list_files(weights):
        found["sha256"] = content_hash(*(f"{path.name} {hash_file(path)}".encode() for path in files))
    return found


def stat_weights(weights: str) -> str:
    """Describe weights on disk by inode, size and time, which change with them, without reading them."""
    stats = ((path.name, path.stat()) for path in _list_files(weights))
    return " ".join(f"{name} {found.st_ino} {found.st_size} {found.st_mtime_ns}" for name, found in stats)


def _list_files(weights: str) -> list[Path]:
    path = Path(weights)
    if weights and path.is_dir():
        return sorted(found for pattern in _WEIGHT_FILES for found in path.glob(pattern) if found.is_file())
    return [path] if weights and path.is_file() else []


def _read_commit(package: str) -> str:
    """Return the installed commit after a blank; nothing if the package was not installed from git."""
    try:
        origin = json.loads(distribution(package).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        return ""
    commit = origin.get("vcs_info", {}).get("commit_id", "")
    return f" {commit}" if commit else ""


def identify_onnx_model(weights: str) -> dict[str, Any]:
    """Collect the version of onnxruntime, and the hash of an ONNX file if it exists."""
    path = Path(weights)
    found: dict[str, Any] = {"onnxruntime": _read_version("onnxruntime")}
    return {**found, "sha256": hash_file(path)} if path.is_file() else found


def _read_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"
