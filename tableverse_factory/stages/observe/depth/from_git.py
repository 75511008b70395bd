"""Packages of depth models that no index has: asked for where they are used, and missed in one line."""

import importlib
from importlib.util import find_spec
from types import ModuleType

from tableverse_factory.core.errors import ModelAccessError

PACKAGES = {
    "depth_anything_3": ("Depth Anything 3", "git+https://github.com/ByteDance-Seed/Depth-Anything-3"),
    "moge": ("MoGe-2", "git+https://github.com/microsoft/MoGe"),
}
"""By module: what it is called, and what pip installs. Names like these on PyPI are not the authors'."""


def package(module: str) -> ModuleType:
    """A module of one of `PACKAGES`.

    Raises:
        ModelAccessError: saying what to install.
    """
    name, source = PACKAGES[module.partition(".")[0]]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        lack = "" if missing == module.partition(".")[0] else f" whole: {missing} is missing"
        raise ModelAccessError(f"{name} is not installed{lack}; pip install '{source}'") from None


def is_there(module: str) -> bool:
    """Whether a package of this name is installed; what it needs itself is not looked at."""
    return find_spec(module) is not None
