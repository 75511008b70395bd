"""Packages of depth models that are installed from git, because no package index has them."""

import importlib
from types import ModuleType

from tableverse_factory.core.errors import ModelAccessError

# Name and pip source by module; similar names on PyPI are not the authors'
PACKAGES = {
    "depth_anything_3": ("Depth Anything 3", "git+https://github.com/ByteDance-Seed/Depth-Anything-3"),
    "moge": ("MoGe-2", "git+https://github.com/microsoft/MoGe"),
}


def import_git_package(module: str) -> ModuleType:
    """Import a module of one of `PACKAGES`; the error says what to install."""
    name, source = PACKAGES[module.partition(".")[0]]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        lack = "" if missing == module.partition(".")[0] else f" whole: {missing} is missing"
        raise ModelAccessError(f"{name} is not installed{lack}; pip install '{source}'") from None
