"""Optional packages: imported where they are used, and missed with one line that says how to install them."""

import importlib
from types import ModuleType

from tableverse_factory.core.errors import InputError


def import_extra(module: str, what: str, extra: str) -> ModuleType:
    """Import a module, or raise `no_extra`, saying that `what` (`the viewer`) needs this project's `extra`."""
    try:
        return importlib.import_module(module)
    except ImportError:
        line = f"{what} needs {module.partition('.')[0]}: pip install 'tableverse-factory[{extra}]'"
        raise InputError(line, "no_extra") from None
