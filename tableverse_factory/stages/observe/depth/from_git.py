"""Packages of depth models that are installed from git, because no package index has them."""

import importlib
from importlib.util import find_spec
from types import ModuleType

from tableverse_factory.core.errors import ModelAccessError

PACKAGES = {
    "depth_anything_3": ("Depth Anything 3", "git+https://github.com/ByteDance-Seed/Depth-Anything-3"),
    "moge": ("MoGe-2", "git+https://github.com/microsoft/MoGe"),
}
"""Name and pip source by module. Similar names on PyPI are not the authors'."""


def import_git_package(module: str) -> ModuleType:
    """Import a module of one of `PACKAGES`.

    Raises:
        ModelAccessError: if it is not installed; says what to install.
    """
    name, source = PACKAGES[module.partition(".")[0]]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = (error.name or module).partition(".")[0]
        lack = "" if missing == module.partition(".")[0] else f" whole: {missing} is missing"
        raise ModelAccessError(f"{name} is not installed{lack}; pip install '{source}'") from None


def is_installed(module: str) -> bool:
    """Whether a package is installed; its dependencies are not checked."""
    return find_spec(module) is not None
