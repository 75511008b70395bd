"""Packages of depth models that are installed from git, because no package index has them."""

import importlib
import importlib.util
from types import ModuleType

from tableverse_factory.core.errors import WeightsError

# Name and pip source by module; similar names on PyPI are not the authors'
PACKAGES = {
    "depth_anything_3": ("Depth Anything 3", "git+https://github.com/ByteDance-Seed/Depth-Anything-3"),
    "moge": ("MoGe-2", "git+https://github.com/microsoft/MoGe"),
}
MOGE_CHECKPOINT = "model.pt"  # in a local folder; names on the hub the package resolves itself


def check_git_package(package: str) -> None:
    """Check that one of `PACKAGES` is installed, without importing it; WeightsError if it is not."""
    if importlib.util.find_spec(package) is None:
        raise WeightsError(_describe_missing(package))


def import_git_package(module: str) -> ModuleType:
    """Import a module of one of `PACKAGES`; the error says what to install."""
    package = module.partition(".")[0]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        raise WeightsError(_describe_missing(package, missing)) from None


def _describe_missing(package: str, missing: str = "") -> str:
    name, source = PACKAGES[package]
    lack = f" whole: {missing} is missing" if missing not in ("", package) else ""
    return f"{name} is not installed{lack}; pip install '{source}'"
